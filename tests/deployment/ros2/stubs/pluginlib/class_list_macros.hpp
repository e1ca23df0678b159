// Stub of pluginlib for tests: the harness makes the controller through this function.
#ifndef PLUGINLIB__CLASS_LIST_MACROS_HPP_
#define PLUGINLIB__CLASS_LIST_MACROS_HPP_

#include <memory>

#define PLUGINLIB_EXPORT_CLASS(class_type, base_class_type) \
  std::shared_ptr<base_class_type> make_plugin(); \
  std::shared_ptr<base_class_type> make_plugin() {return std::make_shared<class_type>();}

#endif  // PLUGINLIB__CLASS_LIST_MACROS_HPP_
