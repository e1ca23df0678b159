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
  template<typename Callback>
  rclcpp::node_interfaces::OnSetParametersCallbackHandle::SharedPtr
  add_on_set_parameters_callback(Callback callback)
  {
    using Handle = rclcpp::node_interfaces::OnSetParametersCallbackHandle;
    const auto handle = std::make_shared<Handle>(Handle{callback});
    on_set_ = handle;
    return handle;
  }

  // Of the harness.
  rcl_interfaces::msg::SetParametersResult set(const rclcpp::Parameter & parameter)
  {
    rcl_interfaces::msg::SetParametersResult answer;
    answer.successful = true;
    if (const auto handle = on_set_.lock()) {
      answer = handle->callback({parameter});
    }
    if (answer.successful) {
      parameters[parameter.get_name()] = parameter;
    }
    return answer;
  }
  std::map<std::string, rclcpp::Parameter> parameters;
  rclcpp::TimerBase::SharedPtr timer;

private:
  // As in rclcpp, the callback ends with the last owner of its handle.
  std::weak_ptr<rclcpp::node_interfaces::OnSetParametersCallbackHandle> on_set_;
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
