// Declarations that mirror rclcpp 28.1.6, and a double that behaves alike; see ../README.md.
#pragma once

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "rcl_interfaces/msg/parameter_event.hpp"
#include "rclcpp/serialization.hpp"
#include "rclcpp/serialized_message.hpp"

#define RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED UINT64_MAX
#define RCLCPP_INFO(logger, ...) rclcpp::stub_log(logger, __VA_ARGS__)
#define RCLCPP_WARN(logger, ...) rclcpp::stub_log(logger, __VA_ARGS__)
#define RCLCPP_ERROR(logger, ...) rclcpp::stub_log(logger, __VA_ARGS__)

struct rmw_message_info_t
{
  std::int64_t source_timestamp;
  std::int64_t received_timestamp;
  std::uint64_t publication_sequence_number;
  std::uint64_t reception_sequence_number;
};

struct rmw_request_id_t
{
  std::int8_t writer_guid[16];
  std::int64_t sequence_number;
};

enum rcl_clock_type_t {RCL_CLOCK_UNINITIALIZED, RCL_ROS_TIME, RCL_SYSTEM_TIME, RCL_STEADY_TIME};

namespace rosidl_generator_traits
{

template<typename MessageT>
const char * name() {return "stub/msg/Stub";}

}  // namespace rosidl_generator_traits

namespace rclcpp
{

/// Number of parameter services that exist.
inline int stub_parameter_services = 0;

class Logger {};

[[gnu::format(printf, 2, 3)]] inline void stub_log(const Logger &, const char *, ...) {}

enum class ReliabilityPolicy {BestEffort, Reliable, SystemDefault};
enum class HistoryPolicy {KeepLast, KeepAll, SystemDefault};
enum class IntraProcessSetting {Enable, Disable, NodeDefault};

struct QoSInitialization
{
  std::size_t depth;
};

struct KeepLast : QoSInitialization
{
  explicit KeepLast(std::size_t depth)
  : QoSInitialization{depth} {}
};

class QoS
{
public:
  explicit QoS(const QoSInitialization & initialization)
  : depth_(initialization.depth) {}
  QoS(std::size_t depth)  // NOLINT: as in rclcpp, 10 is a QoS
  : depth_(depth) {}
  QoS & reliable() {return *this;}
  QoS & transient_local() {return *this;}
  ReliabilityPolicy reliability() const {return ReliabilityPolicy::Reliable;}
  HistoryPolicy history() const {return HistoryPolicy::KeepLast;}
  std::size_t depth() const {return depth_;}

private:
  std::size_t depth_;
};

struct ServicesQoS : QoS
{
  ServicesQoS()
  : QoS(10) {}
};

struct ParametersQoS : QoS
{
  ParametersQoS()
  : QoS(1000) {}
};

struct PublisherOptions
{
  IntraProcessSetting use_intra_process_comm = IntraProcessSetting::NodeDefault;
};

struct SubscriptionOptions
{
  IntraProcessSetting use_intra_process_comm = IntraProcessSetting::NodeDefault;
};

class MessageInfo
{
public:
  const rmw_message_info_t & get_rmw_message_info() const {return info_;}

private:
  rmw_message_info_t info_{};
};

class PreShutdownCallbackHandle
{
public:
  int number = 0;
};

class Context
{
public:
  using SharedPtr = std::shared_ptr<Context>;

  PreShutdownCallbackHandle add_pre_shutdown_callback(std::function<void()> callback)
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    callbacks_[++last_] = std::move(callback);
    return {last_};
  }

  bool remove_pre_shutdown_callback(const PreShutdownCallbackHandle & handle)
  {
    const std::lock_guard<std::mutex> lock(mutex_);
    return callbacks_.erase(handle.number) > 0;
  }

  bool is_valid() const {return is_valid_;}

  bool shutdown(const std::string &)
  {
    {
      const std::lock_guard<std::mutex> lock(mutex_);
      for (const auto & [number, callback] : callbacks_) {
        callback();
      }
    }
    is_valid_ = false;
    return true;
  }

  /// Begin a new life, as `rclcpp::init` does.
  void stub_init() {is_valid_ = true;}

  /// Throw as calls into rcl do after the shutdown.
  void stub_check() const
  {
    if (!is_valid_) {
      throw std::runtime_error("the given context is not valid");
    }
  }

private:
  std::mutex mutex_;
  std::map<int, std::function<void()>> callbacks_;
  int last_ = 0;
  bool is_valid_ = true;
};

inline Context::SharedPtr stub_context()
{
  static const auto context = std::make_shared<Context>();
  return context;
}

class NodeOptions
{
public:
  const std::vector<std::string> & arguments() const {return arguments_;}
  NodeOptions & arguments(const std::vector<std::string> & arguments)
  {
    arguments_ = arguments;
    return *this;
  }
  bool start_parameter_services() const {return start_parameter_services_;}
  NodeOptions & start_parameter_services(bool start)
  {
    start_parameter_services_ = start;
    return *this;
  }
  bool use_intra_process_comms() const {return use_intra_process_comms_;}
  NodeOptions & use_intra_process_comms(bool use)
  {
    use_intra_process_comms_ = use;
    return *this;
  }
  rcl_clock_type_t clock_type() const {return clock_type_;}
  NodeOptions & clock_type(rcl_clock_type_t type)
  {
    clock_type_ = type;
    return *this;
  }

private:
  std::vector<std::string> arguments_;
  bool start_parameter_services_ = true;
  bool use_intra_process_comms_ = false;
  rcl_clock_type_t clock_type_ = RCL_ROS_TIME;
};

class CallbackGroup
{
public:
  using SharedPtr = std::shared_ptr<CallbackGroup>;
};

class Clock
{
public:
  using SharedPtr = std::shared_ptr<Clock>;

  explicit Clock(rcl_clock_type_t type)
  : type_(type) {}
  rcl_clock_type_t get_clock_type() const {return type_;}
  bool ros_time_is_active()
  {
    if (type_ != RCL_ROS_TIME) {
      throw std::runtime_error("Failed to check ros_time_override_status");
    }
    return false;
  }

private:
  rcl_clock_type_t type_;
};

class TimerBase
{
public:
  using SharedPtr = std::shared_ptr<TimerBase>;

  TimerBase(std::chrono::nanoseconds period, std::function<void()> callback)
  : period_(period), callback_(std::move(callback))
  {
    stub_context()->stub_check();
    if (period.count() < 0) {
      throw std::invalid_argument("timer period cannot be negative");
    }
    reset();
  }
  virtual ~TimerBase() = default;

  void cancel() {is_canceled_ = true;}
  bool is_canceled() {return is_canceled_;}
  void reset()
  {
    is_canceled_ = false;
    due_ = std::chrono::steady_clock::now() + period_;
  }
  std::chrono::nanoseconds time_until_trigger()
  {
    return is_canceled_ ? std::chrono::nanoseconds::max() : due_ - std::chrono::steady_clock::now();
  }

  /// Call the callback if the timer is due.
  void stub_run()
  {
    if (!is_canceled_ && due_ <= std::chrono::steady_clock::now()) {
      due_ += period_;
      callback_();
    }
  }

private:
  std::chrono::nanoseconds period_;
  std::function<void()> callback_;
  std::chrono::steady_clock::time_point due_;
  bool is_canceled_ = false;
};

inline std::vector<std::weak_ptr<TimerBase>> stub_timers;

template<typename CallbackT>
class GenericTimer : public TimerBase
{
public:
  using SharedPtr = std::shared_ptr<GenericTimer>;
  using TimerBase::TimerBase;
};

template<typename CallbackT>
class WallTimer : public GenericTimer<CallbackT>
{
public:
  using SharedPtr = std::shared_ptr<WallTimer>;
  using GenericTimer<CallbackT>::GenericTimer;
};

/// Newest serialised messages, by their topics.
inline std::map<std::string, std::vector<std::uint8_t>> stub_published;
/// Callbacks of the subscriptions that take serialised messages, by their topics.
inline std::map<std::string, std::function<void(const std::vector<std::uint8_t> &)>> stub_readers;

template<typename MessageT>
class Publisher
{
public:
  using SharedPtr = std::shared_ptr<Publisher>;

  Publisher(std::string topic, bool is_intra_process)
  : topic_(std::move(topic)), is_intra_process_(is_intra_process) {}

  void publish(std::unique_ptr<MessageT>) {}
  void publish(const MessageT &) {}  // after the shutdown, too
  void publish(const SerializedMessage & message)
  {
    if (is_intra_process_) {
      throw std::runtime_error("storing serialized messages in intra process is not supported yet");
    }
    stub_context()->stub_check();
    stub_published[topic_] = message.stub_content();
  }
  const char * get_topic_name() const {return topic_.c_str();}
  std::size_t get_subscription_count() const {return 0;}  // after the shutdown, too

  template<typename RepT, typename PeriodT>
  bool wait_for_all_acked(std::chrono::duration<RepT, PeriodT>) const
  {
    stub_context()->stub_check();
    return true;
  }

private:
  std::string topic_;
  bool is_intra_process_;
};

template<typename MessageT>
class Subscription
{
public:
  using SharedPtr = std::shared_ptr<Subscription>;

  Subscription(std::string topic, bool is_intra_process)
  : stub_is_intra_process(is_intra_process), topic_(std::move(topic)) {}

  bool take(MessageT &, MessageInfo &) {return false;}
  bool take_serialized(SerializedMessage &, MessageInfo &) {return false;}
  const char * get_topic_name() const {return topic_.c_str();}
  std::size_t get_publisher_count() const
  {
    stub_context()->stub_check();
    return 1;
  }

  /// Messages of this process arrive without a time stamp and a number.
  const bool stub_is_intra_process;

private:
  std::string topic_;
};

template<typename ServiceT>
class Service
{
public:
  using SharedPtr = std::shared_ptr<Service>;
  void send_response(rmw_request_id_t &, typename ServiceT::Response &)
  {
    stub_context()->stub_check();
  }
};

template<typename ServiceT>
class Client
{
public:
  using SharedPtr = std::shared_ptr<Client>;
};

/// Of the types that a parameter may have, as in rcl_interfaces.
enum ParameterType {PARAMETER_NOT_SET = 0, PARAMETER_INTEGER = 2};

class ParameterValue
{
public:
  ParameterValue() = default;
  explicit ParameterValue(std::int64_t value)
  : content_{PARAMETER_INTEGER, value} {}
  explicit ParameterValue(const rcl_interfaces::msg::ParameterValue & content)
  : content_(content) {}
  ParameterType get_type() const {return static_cast<ParameterType>(content_.type);}
  const rcl_interfaces::msg::ParameterValue & to_value_msg() const {return content_;}

private:
  rcl_interfaces::msg::ParameterValue content_;
};

class Parameter
{
public:
  Parameter() = default;
  Parameter(std::string name, const ParameterValue & value)
  : name_(std::move(name)), value_(value) {}
  Parameter(std::string name, std::int64_t value)
  : Parameter(std::move(name), ParameterValue(value)) {}
  const std::string & get_name() const {return name_;}
  ParameterType get_type() const {return value_.get_type();}
  const ParameterValue & get_parameter_value() const {return value_;}
  static Parameter from_parameter_msg(const rcl_interfaces::msg::Parameter & parameter)
  {
    return {parameter.name, ParameterValue(parameter.value)};
  }
  rcl_interfaces::msg::Parameter to_parameter_msg() const {return {name_, value_.to_value_msg()};}

private:
  std::string name_;
  ParameterValue value_;
};

namespace node_interfaces
{

class NodeBaseInterface
{
public:
  Context::SharedPtr get_context() {return stub_context();}
};

class NodeTopicsInterface
{
public:
  explicit NodeTopicsInterface(std::string node = "")
  : node_(std::move(node)) {}
  std::string resolve_topic_name(const std::string & name, bool = false) const
  {
    if (name.empty()) {
      throw std::runtime_error("topic name must not be empty");
    }
    if (name.front() == '/') {
      return name;
    }
    return name.rfind("~/", 0) == 0 ? node_ + name.substr(1) : "/" + name;
  }

private:
  std::string node_;
};

class NodeServicesInterface : private NodeTopicsInterface
{
public:
  using NodeTopicsInterface::NodeTopicsInterface;
  std::string resolve_service_name(const std::string & name, bool = false) const
  {
    return resolve_topic_name(name);
  }
};

class NodeParametersInterface {};

struct PostSetParametersCallbackHandle
{
  using SharedPtr = std::shared_ptr<PostSetParametersCallbackHandle>;
  std::function<void(const std::vector<Parameter> &)> callback;
};

}  // namespace node_interfaces

/// True for the callbacks of subscriptions that the package uses, a part of those of rclcpp.
template<typename MessageT, typename CallbackT>
constexpr bool stub_is_subscriber =
  std::is_invocable_r_v<void, CallbackT, const MessageT &> ||
  std::is_invocable_r_v<void, CallbackT, std::shared_ptr<const MessageT>, const MessageInfo &> ||
  std::is_invocable_r_v<void, CallbackT, std::shared_ptr<const SerializedMessage>>;

/// True for the callback of a service with a deferred answer.
template<typename ServiceT, typename CallbackT>
constexpr bool stub_is_deferring_server = std::is_invocable_r_v<
  void, CallbackT, std::shared_ptr<rmw_request_id_t>,
  std::shared_ptr<typename ServiceT::Request>>;

class TopicEndpointInfo
{
public:
  const std::string & node_name() const {return name_;}

private:
  std::string name_;
};

class Node
{
public:
  using PostSetParametersCallbackHandle = node_interfaces::PostSetParametersCallbackHandle;

  explicit Node(const std::string & name, const NodeOptions & options = NodeOptions())
  : name_("/" + name), options_(options) {stub_context()->stub_check();}
  virtual ~Node() = default;

  const char * get_fully_qualified_name() const {return name_.c_str();}
  Logger get_logger() const {return {};}
  std::vector<TopicEndpointInfo> get_subscriptions_info_by_topic(
    const std::string &, bool = false) const
  {
    stub_context()->stub_check();
    return {};
  }
  Clock::SharedPtr get_clock() {return std::make_shared<Clock>(options_.clock_type());}

  template<typename MessageT>
  std::shared_ptr<Publisher<MessageT>> create_publisher(
    const std::string & topic, const QoS &, const PublisherOptions & options = {})
  {
    stub_context()->stub_check();
    return std::make_shared<Publisher<MessageT>>(
      topics_.resolve_topic_name(topic), stub_is_intra_process(options.use_intra_process_comm));
  }

  template<typename MessageT, typename CallbackT>
  std::shared_ptr<Subscription<MessageT>> create_subscription(
    const std::string & topic, const QoS &, CallbackT && callback,
    const SubscriptionOptions & options = {})
  {
    static_assert(stub_is_subscriber<MessageT, CallbackT>);
    stub_context()->stub_check();
    const std::string name = topics_.resolve_topic_name(topic);
    if constexpr (std::is_invocable_v<CallbackT, std::shared_ptr<const SerializedMessage>>) {
      stub_readers[name] = [callback](const std::vector<std::uint8_t> & content) {
          const auto message = std::make_shared<SerializedMessage>();
          message->stub_assign(content);
          callback(message);
        };
    }
    return std::make_shared<Subscription<MessageT>>(
      name, stub_is_intra_process(options.use_intra_process_comm));
  }

  template<typename RepT, typename PeriodT, typename CallbackT>
  typename WallTimer<CallbackT>::SharedPtr create_wall_timer(
    std::chrono::duration<RepT, PeriodT> period, CallbackT callback,
    CallbackGroup::SharedPtr = nullptr, bool = true)
  {
    static_assert(std::is_invocable_r_v<void, CallbackT>);
    const auto timer = std::make_shared<WallTimer<CallbackT>>(period, callback);
    stub_timers.push_back(timer);
    return timer;
  }

  template<typename RepT, typename PeriodT, typename CallbackT>
  typename GenericTimer<CallbackT>::SharedPtr create_timer(
    std::chrono::duration<RepT, PeriodT> period, CallbackT callback,
    CallbackGroup::SharedPtr = nullptr)
  {
    static_assert(std::is_invocable_r_v<void, CallbackT>);
    const auto timer = std::make_shared<GenericTimer<CallbackT>>(period, callback);
    stub_timers.push_back(timer);
    return timer;
  }

  template<typename ServiceT, typename CallbackT>
  typename Service<ServiceT>::SharedPtr create_service(
    const std::string &, CallbackT &&, const QoS & = ServicesQoS(),
    CallbackGroup::SharedPtr = nullptr)
  {
    static_assert(stub_is_deferring_server<ServiceT, CallbackT>);
    stub_context()->stub_check();
    return std::make_shared<Service<ServiceT>>();
  }

  template<typename ServiceT>
  typename Client<ServiceT>::SharedPtr create_client(
    const std::string &, const QoS & = ServicesQoS(), CallbackGroup::SharedPtr = nullptr)
  {
    stub_context()->stub_check();
    return std::make_shared<Client<ServiceT>>();
  }

  const ParameterValue & declare_parameter(
    const std::string & name, const ParameterValue & default_value)
  {
    if (default_value.get_type() == PARAMETER_NOT_SET) {
      throw std::invalid_argument(
              "cannot declare a statically typed parameter with an uninitialized value");
    }
    stub_declare(name);
    stub_call_post_set({Parameter(name, default_value)});  // it has no parameter of the name yet
    return parameters_[name] = default_value;
  }

  /// Declare a parameter with a type, but without a value.
  const ParameterValue & declare_parameter(const std::string & name, ParameterType)
  {
    stub_declare(name);
    return parameters_[name];
  }

  bool has_parameter(const std::string & name) const {return parameters_.count(name) > 0;}

  Parameter get_parameter(const std::string & name) const
  {
    Parameter parameter;
    if (!get_parameter(name, parameter)) {
      throw std::runtime_error("parameter '" + name + "' is not declared or not initialized");
    }
    return parameter;
  }

  /// Return false if a parameter is not declared, or has no value.
  bool get_parameter(const std::string & name, Parameter & parameter) const
  {
    const auto found = parameters_.find(name);
    if (found == parameters_.end() || found->second.get_type() == PARAMETER_NOT_SET) {
      return false;
    }
    parameter = Parameter(name, found->second);
    return true;
  }

  std::vector<Parameter> get_parameters(const std::vector<std::string> & names) const
  {
    std::vector<Parameter> found;
    for (const auto & name : names) {
      found.push_back(get_parameter(name));
    }
    return found;
  }

  rcl_interfaces::msg::SetParametersResult set_parameters_atomically(
    const std::vector<Parameter> & parameters)
  {
    if (parameters.empty()) {
      return {false, "parameter list cannot be empty"};
    }
    for (const auto & one : parameters) {
      if (!has_parameter(one.get_name())) {
        throw std::runtime_error("parameter '" + one.get_name() + "' was not declared");
      }
      if (one.get_type() == PARAMETER_NOT_SET) {
        return {false, "cannot undeclare a statically typed parameter"};
      }
    }
    for (const auto & one : parameters) {
      parameters_[one.get_name()] = one.get_parameter_value();
    }
    stub_call_post_set(parameters);
    return {true, ""};
  }

  rcl_interfaces::msg::ListParametersResult list_parameters(
    const std::vector<std::string> &, std::uint64_t) const
  {
    rcl_interfaces::msg::ListParametersResult result;
    for (const auto & [name, value] : parameters_) {
      result.names.push_back(name);
    }
    return result;
  }

  /// The node calls the function as long as the caller has the handle.
  PostSetParametersCallbackHandle::SharedPtr add_post_set_parameters_callback(
    std::function<void(const std::vector<Parameter> &)> callback)
  {
    const auto handle = std::make_shared<PostSetParametersCallbackHandle>();
    handle->callback = std::move(callback);
    post_set_.push_back(handle);
    return handle;
  }

  std::shared_ptr<node_interfaces::NodeBaseInterface> get_node_base_interface()
  {
    return std::make_shared<node_interfaces::NodeBaseInterface>();
  }
  std::shared_ptr<node_interfaces::NodeTopicsInterface> get_node_topics_interface()
  {
    return std::make_shared<node_interfaces::NodeTopicsInterface>(topics_);
  }
  std::shared_ptr<node_interfaces::NodeServicesInterface> get_node_services_interface()
  {
    return std::make_shared<node_interfaces::NodeServicesInterface>(name_);
  }
  std::shared_ptr<node_interfaces::NodeParametersInterface> get_node_parameters_interface()
  {
    return std::make_shared<node_interfaces::NodeParametersInterface>();
  }

private:
  void stub_call_post_set(const std::vector<Parameter> & parameters)
  {
    for (const auto & weak : post_set_) {
      if (const auto handle = weak.lock()) {
        handle->callback(parameters);
      }
    }
  }

  void stub_declare(const std::string & name) const
  {
    if (name.empty() || has_parameter(name)) {
      throw std::invalid_argument("parameter '" + name + "' has no name, or is declared already");
    }
  }

  bool stub_is_intra_process(IntraProcessSetting setting) const
  {
    return setting == IntraProcessSetting::Enable ||
           (setting == IntraProcessSetting::NodeDefault && options_.use_intra_process_comms());
  }

  std::string name_;
  NodeOptions options_;
  node_interfaces::NodeTopicsInterface topics_{name_};
  std::map<std::string, ParameterValue> parameters_;
  std::vector<std::weak_ptr<PostSetParametersCallbackHandle>> post_set_;
};

inline void init(int, char const * const *) {stub_context()->stub_init();}
inline bool shutdown() {return stub_context()->shutdown("");}

/// Call the timers that are due, once each.
inline void stub_spin_once()
{
  const auto timers = stub_timers;
  for (const auto & weak : timers) {
    if (const auto timer = weak.lock()) {
      timer->stub_run();
    }
  }
}

inline void spin(std::shared_ptr<Node>) {}

}  // namespace rclcpp
