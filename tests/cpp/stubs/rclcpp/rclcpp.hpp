// Declarations that mirror rclcpp 28.1.6; see ../README.md.
#pragma once

#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <type_traits>
#include <vector>

#include "rcl_interfaces/msg/parameter_event.hpp"
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

namespace rosidl_generator_traits
{

template<typename MessageT>
const char * name();

}  // namespace rosidl_generator_traits

namespace rclcpp
{

class Logger {};

[[gnu::format(printf, 2, 3)]] void stub_log(const Logger & logger, const char * format, ...);

enum class ReliabilityPolicy {BestEffort, Reliable, SystemDefault};
enum class HistoryPolicy {KeepLast, KeepAll, SystemDefault};

struct QoSInitialization {};

struct KeepLast : QoSInitialization
{
  explicit KeepLast(std::size_t depth);
};

class QoS
{
public:
  explicit QoS(const QoSInitialization & initialization);
  QoS(std::size_t depth);  // NOLINT: as in rclcpp, 10 is a QoS
  QoS & reliable();
  QoS & transient_local();
  ReliabilityPolicy reliability() const;
  HistoryPolicy history() const;
  std::size_t depth() const;
};

struct ServicesQoS : QoS
{
  ServicesQoS();
};

struct ParametersQoS : QoS
{
  ParametersQoS();
};

class MessageInfo
{
public:
  const rmw_message_info_t & get_rmw_message_info() const;
};

class PreShutdownCallbackHandle {};

class Context
{
public:
  using SharedPtr = std::shared_ptr<Context>;
  PreShutdownCallbackHandle add_pre_shutdown_callback(std::function<void()> callback);
  bool remove_pre_shutdown_callback(const PreShutdownCallbackHandle & handle);
};

class NodeOptions
{
public:
  const std::vector<std::string> & arguments() const;
  NodeOptions & arguments(const std::vector<std::string> & arguments);
  NodeOptions & start_parameter_services(bool start);
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
  bool ros_time_is_active();
};

class TimerBase
{
public:
  using SharedPtr = std::shared_ptr<TimerBase>;
  void cancel();
  bool is_canceled();
  void reset();
  std::chrono::nanoseconds time_until_trigger();
};

template<typename CallbackT>
class GenericTimer : public TimerBase
{
public:
  using SharedPtr = std::shared_ptr<GenericTimer>;
};

template<typename CallbackT>
class WallTimer : public GenericTimer<CallbackT>
{
public:
  using SharedPtr = std::shared_ptr<WallTimer>;
};

template<typename MessageT>
class Publisher
{
public:
  using SharedPtr = std::shared_ptr<Publisher>;
  void publish(std::unique_ptr<MessageT> message);
  void publish(const MessageT & message);
  void publish(const SerializedMessage & message);
  const char * get_topic_name() const;
  std::size_t get_subscription_count() const;

  template<typename RepT, typename PeriodT>
  bool wait_for_all_acked(std::chrono::duration<RepT, PeriodT> timeout) const;
};

template<typename MessageT>
class Subscription
{
public:
  using SharedPtr = std::shared_ptr<Subscription>;
  bool take(MessageT & message, MessageInfo & info);
  bool take_serialized(SerializedMessage & message, MessageInfo & info);
  const char * get_topic_name() const;
  std::size_t get_publisher_count() const;
};

template<typename ServiceT>
class Service
{
public:
  using SharedPtr = std::shared_ptr<Service>;
  void send_response(rmw_request_id_t & header, typename ServiceT::Response & response);
};

template<typename ServiceT>
class Client
{
public:
  using SharedPtr = std::shared_ptr<Client>;
};

class ParameterValue {};

class Parameter
{
public:
  const std::string & get_name() const;
  const ParameterValue & get_parameter_value() const;
  static Parameter from_parameter_msg(const rcl_interfaces::msg::Parameter & parameter);
  rcl_interfaces::msg::Parameter to_parameter_msg() const;
};

namespace node_interfaces
{

class NodeBaseInterface
{
public:
  Context::SharedPtr get_context();
};

class NodeTopicsInterface
{
public:
  std::string resolve_topic_name(const std::string & name, bool only_expand = false) const;
};

class NodeServicesInterface
{
public:
  std::string resolve_service_name(const std::string & name, bool only_expand = false) const;
};

class NodeParametersInterface {};

struct PostSetParametersCallbackHandle
{
  using SharedPtr = std::shared_ptr<PostSetParametersCallbackHandle>;
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
  const std::string & node_name() const;
};

class Node
{
public:
  using PostSetParametersCallbackHandle = node_interfaces::PostSetParametersCallbackHandle;

  explicit Node(const std::string & name, const NodeOptions & options = NodeOptions());
  virtual ~Node();

  const char * get_fully_qualified_name() const;
  Logger get_logger() const;
  std::vector<TopicEndpointInfo> get_subscriptions_info_by_topic(
    const std::string & topic_name, bool no_mangle = false) const;
  Clock::SharedPtr get_clock();

  template<typename MessageT>
  std::shared_ptr<Publisher<MessageT>> create_publisher(
    const std::string & topic, const QoS & qos);

  template<typename MessageT, typename CallbackT>
  std::shared_ptr<Subscription<MessageT>> create_subscription(
    const std::string &, const QoS &, CallbackT &&)
  {
    static_assert(stub_is_subscriber<MessageT, CallbackT>);
    return nullptr;
  }

  template<typename RepT, typename PeriodT, typename CallbackT>
  typename WallTimer<CallbackT>::SharedPtr create_wall_timer(
    std::chrono::duration<RepT, PeriodT>, CallbackT, CallbackGroup::SharedPtr = nullptr,
    bool = true)
  {
    static_assert(std::is_invocable_r_v<void, CallbackT>);
    return nullptr;
  }

  template<typename RepT, typename PeriodT, typename CallbackT>
  typename GenericTimer<CallbackT>::SharedPtr create_timer(
    std::chrono::duration<RepT, PeriodT>, CallbackT, CallbackGroup::SharedPtr = nullptr)
  {
    static_assert(std::is_invocable_r_v<void, CallbackT>);
    return nullptr;
  }

  template<typename ServiceT, typename CallbackT>
  typename Service<ServiceT>::SharedPtr create_service(
    const std::string &, CallbackT &&, const QoS & = ServicesQoS(),
    CallbackGroup::SharedPtr = nullptr)
  {
    static_assert(stub_is_deferring_server<ServiceT, CallbackT>);
    return nullptr;
  }

  template<typename ServiceT>
  typename Client<ServiceT>::SharedPtr create_client(
    const std::string & name, const QoS & qos = ServicesQoS(),
    CallbackGroup::SharedPtr group = nullptr);

  const ParameterValue & declare_parameter(
    const std::string & name, const ParameterValue & default_value);
  bool has_parameter(const std::string & name) const;
  Parameter get_parameter(const std::string & name) const;
  std::vector<Parameter> get_parameters(const std::vector<std::string> & names) const;
  rcl_interfaces::msg::SetParametersResult set_parameters_atomically(
    const std::vector<Parameter> & parameters);
  rcl_interfaces::msg::ListParametersResult list_parameters(
    const std::vector<std::string> & prefixes, std::uint64_t depth) const;
  PostSetParametersCallbackHandle::SharedPtr add_post_set_parameters_callback(
    std::function<void(const std::vector<Parameter> &)> callback);

  std::shared_ptr<node_interfaces::NodeBaseInterface> get_node_base_interface();
  std::shared_ptr<node_interfaces::NodeTopicsInterface> get_node_topics_interface();
  std::shared_ptr<node_interfaces::NodeServicesInterface> get_node_services_interface();
  std::shared_ptr<node_interfaces::NodeParametersInterface> get_node_parameters_interface();
};

void init(int argc, char const * const * argv);
void spin(std::shared_ptr<Node> node);
bool shutdown();

}  // namespace rclcpp
