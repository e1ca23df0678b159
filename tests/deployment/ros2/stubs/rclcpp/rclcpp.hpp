// Stub of rclcpp for tests: what the generated controller uses, with the signatures of rclcpp.
#ifndef RCLCPP__RCLCPP_HPP_
#define RCLCPP__RCLCPP_HPP_

#include <cstdint>
#include <cstdio>
#include <functional>
#include <memory>
#include <string>
#include <vector>

namespace rcl_interfaces::msg
{

struct SetParametersResult
{
  bool successful = false;
  std::string reason;
};

}  // namespace rcl_interfaces::msg

namespace rclcpp
{

class Time
{
public:
  explicit Time(std::int64_t nanoseconds)
  : nanoseconds_(nanoseconds) {}
  std::int64_t nanoseconds() const {return nanoseconds_;}

private:
  std::int64_t nanoseconds_;
};

class Duration
{
public:
  explicit Duration(std::int64_t nanoseconds)
  : nanoseconds_(nanoseconds) {}
  std::int64_t nanoseconds() const {return nanoseconds_;}

private:
  std::int64_t nanoseconds_;
};

class TimerBase
{
public:
  using SharedPtr = std::shared_ptr<TimerBase>;
  explicit TimerBase(std::function<void()> callback)
  : callback(callback) {}
  std::function<void()> callback;
};

class Logger {};

// One of the kinds of values that the controller declares.
class Parameter
{
public:
  Parameter() = default;
  explicit Parameter(const std::string & value)
  : text(value) {}
  explicit Parameter(const std::vector<std::string> & value)
  : texts(value) {}
  explicit Parameter(const std::vector<double> & value)
  : numbers(value) {}
  explicit Parameter(bool value)
  : flag(value) {}
  Parameter(const std::string & name, const std::vector<double> & value)
  : numbers(value), name(name) {}
  const std::string & get_name() const {return name;}
  bool as_bool() const {return flag;}
  std::string as_string() const {return text;}
  std::vector<std::string> as_string_array() const {return texts;}
  std::vector<double> as_double_array() const {return numbers;}

private:
  std::string text;
  std::vector<std::string> texts;
  std::vector<double> numbers;
  bool flag = false;
  std::string name;
};

namespace node_interfaces
{

struct OnSetParametersCallbackHandle
{
  using SharedPtr = std::shared_ptr<OnSetParametersCallbackHandle>;
  std::function<rcl_interfaces::msg::SetParametersResult(const std::vector<Parameter> &)> callback;
};

}  // namespace node_interfaces

// What the harness reads in the place of a log.
inline std::vector<std::string> & log()
{
  static std::vector<std::string> lines;
  return lines;
}

inline std::string logged_text(const char * text) {return text;}

template<typename ... Arguments>
std::string logged_text(const char * format, Arguments ... arguments)
{
  char buffer[1024];
  std::snprintf(buffer, sizeof(buffer), format, arguments ...);
  return buffer;
}

}  // namespace rclcpp

#define RCLCPP_ERROR(logger, ...) \
  do { \
    (void)(logger); \
    rclcpp::log().push_back(rclcpp::logged_text(__VA_ARGS__)); \
  } while (0)

#endif  // RCLCPP__RCLCPP_HPP_
