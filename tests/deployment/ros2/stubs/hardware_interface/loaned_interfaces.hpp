// Stub of hardware_interface for tests: loaned interfaces with the functions of ros2_control 6, or
// with those of ros2_control 2 if STUB_OF_HUMBLE is defined.
#ifndef HARDWARE_INTERFACE__LOANED_INTERFACES_HPP_
#define HARDWARE_INTERFACE__LOANED_INTERFACES_HPP_

#include <optional>
#include <string>

namespace hardware_interface
{

class LoanedInterface
{
public:
  LoanedInterface(const std::string & prefix, const std::string & interface, double * value)
  : prefix_(prefix), interface_(interface), value_(value) {}
  LoanedInterface(const LoanedInterface &) = delete;
  LoanedInterface(LoanedInterface &&) = default;
#ifdef STUB_OF_HUMBLE
  const std::string get_prefix_name() const {return prefix_;}
  const std::string get_interface_name() const {return interface_;}
  double get_value() const {return *value_;}
#else
  const std::string & get_prefix_name() const {return prefix_;}
  const std::string & get_interface_name() const {return interface_;}
  template<typename T = double>
  [[nodiscard]] std::optional<T> get_optional(unsigned int max_tries = 10) const
  {
    return max_tries > 0 ? std::optional<T>(*value_) : std::nullopt;
  }
#endif

protected:
  std::string prefix_, interface_;
  double * value_;
};

using LoanedStateInterface = LoanedInterface;

class LoanedCommandInterface : public LoanedInterface
{
public:
  using LoanedInterface::LoanedInterface;
#ifdef STUB_OF_HUMBLE
  void set_value(double value) {*value_ = value;}
#else
  template<typename T>
  [[nodiscard]] bool set_value(const T & value, unsigned int max_tries = 10)
  {
    *value_ = value;
    return max_tries > 0;
  }
#endif
};

}  // namespace hardware_interface

#endif  // HARDWARE_INTERFACE__LOANED_INTERFACES_HPP_
