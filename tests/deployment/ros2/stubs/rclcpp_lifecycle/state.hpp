// Stub of rclcpp_lifecycle for tests.
#ifndef RCLCPP_LIFECYCLE__STATE_HPP_
#define RCLCPP_LIFECYCLE__STATE_HPP_

#include <map>
#include <memory>
#include <string>

#include "rclcpp/rclcpp.hpp"

namespace rclcpp_lifecycle
{

class State {};

class LifecycleNode
{
public:
  rclcpp::Logger get_logger() const {return {};}
  rclcpp::Parameter get_parameter(const std::string & name) const {return parameters.at(name);}
  template<typename Period, typename Callback>
  rclcpp::TimerBase::SharedPtr create_wall_timer(Period, Callback callback)
  {
    timer = std::make_shared<rclcpp::TimerBase>(callback);
    return timer;
  }

  // Of the harness.
  std::map<std::string, rclcpp::Parameter> parameters;
  rclcpp::TimerBase::SharedPtr timer;
};

namespace node_interfaces
{
class LifecycleNodeInterface
{
public:
  enum class CallbackReturn { SUCCESS, FAILURE, ERROR };
};
}  // namespace node_interfaces

}  // namespace rclcpp_lifecycle

#endif  // RCLCPP_LIFECYCLE__STATE_HPP_
