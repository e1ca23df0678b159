// Drives a controller over its standard input, one command a line, and prints what it does.
//
//   rate HZ                      the update rate
//   text NAME VALUE              a parameter, before `init`
//   texts NAME VALUES...
//   numbers NAME VALUES...
//   flag NAME                    a parameter that is true
//   change NAME VALUES...        a parameter, as `ros2 param set` does; prints the answer
//   init | configure | deactivate | cleanup | timer
//   names                        prints the interfaces that the controller claims
//   activate NAMES...            with these interfaces, such as a/position, in this order
//   set NAME VALUE               a value of a claimed interface, without an update
//   update NANOSECONDS VALUES... with these values of the state interfaces
//
// `update` prints the efforts in the order of the claimed interfaces, and how often the controller
// allocated memory.
#include <cstdlib>
#include <iostream>
#include <map>
#include <memory>
#include <new>
#include <sstream>
#include <string>
#include <vector>

#include "controller_interface/controller_interface.hpp"

std::shared_ptr<controller_interface::ControllerInterface> make_plugin();

namespace
{

unsigned long allocations = 0;

std::vector<std::string> words_of(std::istringstream & line)
{
  std::vector<std::string> words;
  std::string word;
  while (line >> word) {
    words.push_back(word);
  }
  return words;
}

std::vector<double> numbers_of(const std::vector<std::string> & words, std::size_t first)
{
  std::vector<double> numbers;
  for (std::size_t i = first; i < words.size(); i++) {
    numbers.push_back(std::strtod(words[i].c_str(), nullptr));
  }
  return numbers;
}

void print(const std::string & step, controller_interface::CallbackReturn answer)
{
  const bool is_success = answer == controller_interface::CallbackReturn::SUCCESS;
  std::cout << step << (is_success ? " SUCCESS" : " ERROR") << "\n";
}

}  // namespace

void * operator new(std::size_t size)
{
  allocations++;
  void * memory = std::malloc(size);
  if (memory == nullptr) {
    throw std::bad_alloc();
  }
  return memory;
}
void operator delete(void * memory) noexcept {std::free(memory);}
void operator delete(void * memory, std::size_t) noexcept {std::free(memory);}

int main()
{
  const auto controller = make_plugin();
  auto & node = *controller->get_node();
  std::vector<std::string> state_names, effort_names;
  std::map<std::string, double> values;  // addresses of its elements do not change
  const rclcpp_lifecycle::State state;
  std::cout.precision(17);
  std::string text;
  while (std::getline(std::cin, text)) {
    std::istringstream line(text);
    std::string command;
    line >> command;
    const auto words = words_of(line);
    if (command == "rate") {
      controller->update_rate = static_cast<unsigned int>(std::stoul(words[0]));
    } else if (command == "text") {
      node.parameters[words[0]] = rclcpp::Parameter(words[1]);
    } else if (command == "texts") {
      node.parameters[words[0]] =
        rclcpp::Parameter(std::vector<std::string>(words.begin() + 1, words.end()));
    } else if (command == "numbers") {
      node.parameters[words[0]] = rclcpp::Parameter(numbers_of(words, 1));
    } else if (command == "flag") {
      node.parameters[words[0]] = rclcpp::Parameter(true);
    } else if (command == "change") {
      const auto answer = node.set(rclcpp::Parameter(words[0], numbers_of(words, 1)));
      std::cout << "change " << (answer.successful ? "SUCCESS" : "ERROR " + answer.reason) << "\n";
    } else if (command == "cleanup") {
      print("cleanup", controller->on_cleanup(state));
    } else if (command == "init") {
      print("init", controller->on_init());
    } else if (command == "configure") {
      print("configure", controller->on_configure(state));
    } else if (command == "names") {
      for (const auto & configuration : {controller->command_interface_configuration(),
        controller->state_interface_configuration()})
      {
        std::cout << "names";
        for (const auto & name : configuration.names) {
          std::cout << " " << name;
        }
        std::cout << "\n";
      }
    } else if (command == "activate") {
      std::vector<hardware_interface::LoanedCommandInterface> commands;
      std::vector<hardware_interface::LoanedStateInterface> states;
      state_names.clear();
      effort_names.clear();
      for (const auto & word : words) {
        const auto slash = word.find('/');
        const std::string joint = word.substr(0, slash), kind = word.substr(slash + 1);
        double * value = &values.emplace(word, 123.5).first->second;
        if (kind == "effort") {
          commands.emplace_back(joint, kind, value);
          effort_names.push_back(word);
        } else {
          states.emplace_back(joint, kind, value);
          state_names.push_back(word);
        }
      }
      controller->assign_interfaces(std::move(commands), std::move(states));
      print("activate", controller->on_activate(state));
    } else if (command == "set") {
      values[words[0]] = std::strtod(words[1].c_str(), nullptr);
    } else if (command == "deactivate") {
      print("deactivate", controller->on_deactivate(state));
      std::cout << "efforts";
      for (const auto & name : effort_names) {
        std::cout << " " << values[name];
      }
      std::cout << "\n";
    } else if (command == "timer") {
      node.timer->callback();
    } else if (command == "update") {
      for (std::size_t i = 0; i < state_names.size(); i++) {
        values[state_names[i]] = std::strtod(words[i + 1].c_str(), nullptr);
      }
      const rclcpp::Time time(std::stoll(words[0]));
      const auto before = allocations;
      const auto answer = controller->update(time, rclcpp::Duration(0));
      const auto made = allocations - before;
      std::cout << "update " << (answer == controller_interface::return_type::OK ? "OK" : "ERROR");
      for (const auto & name : effort_names) {
        std::cout << " " << values[name];
      }
      std::cout << " allocations " << made << "\n";
    }
    for (const auto & logged : rclcpp::log()) {
      std::cout << "log " << logged << "\n";
    }
    rclcpp::log().clear();
  }
  return 0;
}
