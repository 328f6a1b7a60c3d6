// Cases of `rosrm_node::Node` on the double of rclcpp, which refuses what rclcpp refuses. Each ends
// with an exception if a contract is broken; `contract_run` returns its text.

#include <chrono>
#include <cstdlib>
#include <functional>
#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <thread>

#include "rosrm_node_cpp/core/channel.hpp"
#include "rosrm_node_cpp/node.hpp"
#include "std_msgs/msg/int64.hpp"

using std_msgs::msg::Int64;
using rosrm_node::Node;
using rosrm_node::Phase;

namespace
{

constexpr const char * kConfigTopic = "/rosrm/state_config";
constexpr const char * kChannel = "/rosrm/handoff/one";
std::string directory;
/// True: a parameter is declared with a type, but without a value.
bool has_limit = false;

void expect(bool holds, const std::string & what)
{
  if (!holds) {
    throw std::runtime_error(what);
  }
}

/// Set the environment of an instance, with snapshots if `keeps`.
void become(int instance, bool keeps)
{
  const std::map<std::string, std::string> variables{
    {"ROSRM_INSTANCE", "counter#" + std::to_string(instance)}, {"ROSRM_PROCESS", "counter"},
    {"ROSRM_NODE", "/counter"}, {"ROSRM_STATE_CONFIG", kConfigTopic}, {"ROSRM_MASTER", "m"},
    {"ROSRM_EPOCH", "1"}, {"ROSRM_KEEP", keeps ? directory : ""}, {"ROSRM_KEEP_EVERY", "1"}};
  for (const auto & [name, value] : variables) {
    ::setenv(name.c_str(), value.c_str(), 1);
  }
  rclcpp::stub_context()->stub_init();
  rclcpp::stub_published.clear();
  rclcpp::stub_readers.clear();
}

void spin_until(const std::function<bool()> & condition, const std::string & what)
{
  const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(20);
  while (!condition()) {
    expect(std::chrono::steady_clock::now() < end, "not within 20 s: " + what);
    rclcpp::stub_spin_once();
    std::this_thread::sleep_for(std::chrono::milliseconds(1));
  }
}

/// Default of the parameter `rate`.
std::int64_t rate = 5;

class Counter : public Node
{
public:
  explicit Counter(const rclcpp::NodeOptions & options = rclcpp::NodeOptions())
  : Node("counter", options)
  {
    declare_parameter("rate", rclcpp::ParameterValue(rate));
    if (has_limit) {
      declare_parameter("limit", rclcpp::PARAMETER_INTEGER);
    }
    output = create_publisher<Int64>("count", 10);
    input = create_subscription<Int64>("add", 10, [](const Int64 &) {});
    timer = create_timer(
      std::chrono::milliseconds(1), [this] {
        output->publish(Int64{++count});
        on_tick();
      });
    keep_state<Int64>(
      "~/state", [this]() -> std::optional<Int64> {return Int64{count};},
      [this](const Int64 & state) {count = state.data;});
  }

  std::int64_t value(const std::string & name)
  {
    return get_parameter(name).get_parameter_value().to_value_msg().integer_value;
  }

  std::int64_t count = 0;
  std::function<void()> on_tick = [] {};
  rosrm_node::Publisher<Int64>::SharedPtr output;
  rclcpp::Subscription<Int64>::SharedPtr input;
  rosrm_node::Timer::SharedPtr timer;
};

/// Run an instance to its orderly end, and a second one from the snapshot of the first.
void restart(
  const std::function<void(Counter &)> & first, const std::function<void(Counter &)> & second,
  const rclcpp::NodeOptions & options = rclcpp::NodeOptions())
{
  become(1, true);
  std::int64_t reached = 0;
  {
    Counter one(options);
    first(one);
    spin_until([&] {return one.count >= 3;}, "three counts");
    rclcpp::shutdown();
    reached = one.count;
  }
  become(2, true);
  Counter other(options);
  std::int64_t resumed = 0;
  other.on_tick = [&] {resumed = resumed == 0 ? other.count : resumed;};
  spin_until([&] {return resumed != 0;}, "a count");
  expect(resumed == reached + 1, "it begins with " + std::to_string(resumed));
  second(other);
}

/// Deliver a message of the master or of the other side, as plain as with `security: none`.
template<typename MessageT>
void deliver(
  const std::string & topic, const std::string & principal, const std::string & type,
  const MessageT & message)
{
  const auto link = std::make_shared<rosrm_node::Link>(
    std::nullopt, rosrm_node::kToPeer, rosrm_node::kToPeer);
  rosrm_node::SealedTopic sealed(link, principal, topic, type);
  rclcpp::stub_readers.at(topic)(sealed.seal(encoded(message)));
}

/// Let a source publish its state and its marks for a destination.
void attach()
{
  rosrm_node::StateConfig config;
  config.protocol_version = rosrm_node::kProtocolVersion;
  config.cluster = "m";
  config.epoch = 1;
  config.process = "counter";
  config.source = 1;
  config.destination = 2;
  config.channel = kChannel;
  deliver(kConfigTopic, "instance:counter#1", "rosrm_msgs/msg/StateConfig", config);
  rosrm_node::HandoffReport report;
  report.destination = 2;
  report.instance = 2;
  report.phase = Phase::kShadowing;
  deliver(kChannel, "handoff:counter#2", "rosrm_msgs/msg/HandoffReport", report);
  for (const char * const topic : {"/counter/_rosrm/mark", "/counter/state", kChannel}) {
    expect(rclcpp::stub_published.count(topic) > 0, std::string("nothing was sent on ") + topic);
  }
}

const std::map<std::string, std::function<void()>> kCases{
  {"equal_parameters", [] {
      restart([](Counter &) {}, [](Counter & node) {
          expect(node.value("rate") == 5, "another rate");
        });
    }},
  {"changed_parameters", [] {
      restart(
        [](Counter & node) {
          node.set_parameters_atomically({rclcpp::Parameter("rate", 7)});
          node.declare_parameter("late", rclcpp::ParameterValue(std::int64_t{1}));
        },
        [](Counter & node) {
          expect(node.value("rate") == 7 && node.value("late") == 1, "another rate or no `late`");
        });
    }},
  {"a_new_default", [] {
      restart(
        [](Counter &) {rate = 6;},
        [](Counter & node) {expect(node.value("rate") == 6, "the rate of the earlier program");});
    }},
  {"a_parameter_without_a_value", [] {
      has_limit = true;
      restart([](Counter &) {}, [](Counter &) {});
    }},
  {"a_parameter_without_a_value_here", [] {
      has_limit = true;
      restart(
        [](Counter & node) {node.set_parameters_atomically({rclcpp::Parameter("limit", 3)});},
        [](Counter & node) {expect(node.value("limit") == 3, "another limit");});
    }},
  {"intra_process_communication", [] {
      become(1, false);
      Counter node(rclcpp::NodeOptions().use_intra_process_comms(true));
      expect(!node.input->stub_is_intra_process, "messages would come without time stamps");
      attach();
      spin_until([&] {return node.count >= 3;}, "three counts");
    }},
  {"a_cycle_that_outlives_the_context", [] {
      become(1, false);
      Counter node;
      attach();
      node.on_tick = [] {rclcpp::shutdown();};
      spin_until([&] {return node.count >= 1;}, "a count");
    }},
  {"a_steady_clock", [] {
      restart(
        [](Counter &) {}, [](Counter &) {},
        rclcpp::NodeOptions().clock_type(RCL_STEADY_TIME));
    }},
  {"parameter_services", [] {
      for (const bool wanted : {true, false}) {
        become(1, false);
        Counter node(rclcpp::NodeOptions().start_parameter_services(wanted));
        expect(rclcpp::stub_parameter_services == (wanted ? 1 : 0), "not as the author has set it");
      }
    }},
  {"an_empty_message", [] {
      rosrm_node::serialised_message({});
      try {
        rosrm_node::deserialised<Int64>({});
      } catch (const std::exception &) {
        return;
      }
      throw std::runtime_error("an empty message was read");
    }},
};

}  // namespace

extern "C" {

/// Return the names of all cases, with a space after each.
const char * contract_names()
{
  static std::string names;
  names.clear();
  for (const auto & [name, call] : kCases) {
    names += name + " ";
  }
  return names.c_str();
}

/// Run a case with a directory for snapshots; return why it failed, "": it did not.
const char * contract_run(const char * name, const char * folder)
{
  static std::string fault;
  fault.clear();
  directory = folder;
  try {
    kCases.at(name)();
  } catch (const std::exception & error) {
    fault = error.what();
  }
  return fault.c_str();
}
}
