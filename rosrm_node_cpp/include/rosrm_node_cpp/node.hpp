/// \file
/// `rosrm_node::Node`: rclcpp's node, for processes that rosrm can move with their state.
///
///     class Counter : public rosrm_node::Node
///     {
///     public:
///       Counter()
///       : Node("counter")
///       {
///         output_ = create_publisher<Int64>("count", 10);
///         timer_ = create_wall_timer(100ms, [this] {tick();});
///         keep_state<Int64>(
///           "~/state", [this] {return save();}, [this](const Int64 & state) {restore(state);});
///       }
///
/// The counterpart of `rosrm.node` in Python, with the same names. docs/how-to/stateful-node.md has
/// the rest, docs/reference/handoff-protocol.md the protocol.
#pragma once

#include <atomic>
#include <chrono>
#include <cstdint>
#include <deque>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <set>
#include <string>
#include <utility>
#include <vector>

#include "rclcpp/rclcpp.hpp"
#include "rclcpp/serialization.hpp"
#include "rclcpp/serialized_message.hpp"

#include "rosrm_node_cpp/core/handoff_session.hpp"
#include "rosrm_node_cpp/core/reader_count.hpp"

namespace rosrm_node
{

/// A publisher that sends nothing while its node is a shadow or silent.
template<typename MessageT>
class Publisher
{
public:
  using SharedPtr = std::shared_ptr<Publisher>;
  using Plain = rclcpp::Publisher<MessageT>;

  /// \param gate true while messages are sent; null: always.
  Publisher(typename Plain::SharedPtr plain, std::shared_ptr<std::atomic<bool>> gate)
  : plain_(std::move(plain)), gate_(std::move(gate)) {}

  void publish(const MessageT & message)
  {
    if (!gate_ || *gate_) {
      plain_->publish(message);
    }
  }

  void publish(std::unique_ptr<MessageT> message)
  {
    if (!gate_ || *gate_) {
      plain_->publish(std::move(message));
    }
  }

  const char * get_topic_name() const {return plain_->get_topic_name();}
  std::size_t get_subscription_count() const {return plain_->get_subscription_count();}

private:
  typename Plain::SharedPtr plain_;
  std::shared_ptr<std::atomic<bool>> gate_;
};

/// A timer that runs while its node is active; a successor's first run keeps the source's phase.
class Timer : public std::enable_shared_from_this<Timer>
{
public:
  using SharedPtr = std::shared_ptr<Timer>;

  void cancel();
  void reset();
  bool is_canceled() const;

private:
  friend class Node;

  std::int64_t due() const;
  void start_in(rclcpp::Node & node, std::int64_t nanoseconds);

  rclcpp::TimerBase::SharedPtr plain_;
  /// Runs once after an activation, if the rest of a period is left.
  rclcpp::TimerBase::SharedPtr first_;
  std::chrono::nanoseconds period_{0};
  std::function<void()> tick_;
};

/// rclcpp's node, migratable.
///
/// Without rosrm (started by hand or by a launch file) the node equals rclcpp's. Under rosrm
/// - each callback of a timer, a subscription or a service is a *cycle*, and cycles never overlap;
/// - after a cycle the state is saved and published, if the node has a successor;
/// - a node started as the destination of a handoff is a shadow until it is active: inputs are
///   buffered, timers stopped, services absent, and published messages dropped.
///
/// The methods below replace rclcpp's of the same names. All callbacks are in the node's default
/// callback group. A process has at most one such node.
class Node : public rclcpp::Node
{
public:
  /// \throws std::runtime_error another node of this process is migratable already.
  explicit Node(
    const std::string & name, const rclcpp::NodeOptions & options = rclcpp::NodeOptions());
  ~Node() override;

  /// Name one topic of this node's state; several calls make a state of several parts.
  /// \param topic the state is published on it during a handoff; only the successor can read it.
  /// \param save returns the state, or none: unchanged since the last time.
  /// \param restore overwrites the node's state. A shadow calls it for every received state.
  /// \throws std::invalid_argument the topic was named before.
  template<typename MessageT>
  void keep_state(
    const std::string & topic, std::function<std::optional<MessageT>()> save,
    std::function<void(const MessageT &)> restore);

  /// Call a function when this node becomes active: at once, unless it is a shadow.
  ///
  /// This is for objects that may exist in the active node only, such as an action server. The node
  /// releases the result when it falls silent, and creates it again if it resumes.
  void when_active(std::function<std::shared_ptr<void>()> create);

  template<typename MessageT>
  typename Publisher<MessageT>::SharedPtr create_publisher(
    const std::string & topic, const rclcpp::QoS & qos);

  /// \param buffer in a handoff every message is processed once, by the source or by the
  ///   destination; false: messages are skipped while the node is not active.
  template<typename MessageT>
  typename rclcpp::Subscription<MessageT>::SharedPtr create_subscription(
    const std::string & topic, const rclcpp::QoS & qos,
    std::function<void(const MessageT &)> callback, bool buffer = true);

  /// Create a timer by the monotonic clock.
  Timer::SharedPtr create_wall_timer(
    std::chrono::nanoseconds period, std::function<void()> callback);

  /// Create a timer by the node's clock, which may be simulated.
  Timer::SharedPtr create_timer(std::chrono::nanoseconds period, std::function<void()> callback);

  /// Create a service, whose server exists while this node is active.
  template<typename ServiceT>
  void create_service(
    const std::string & name,
    std::function<void(
      std::shared_ptr<typename ServiceT::Request>,
      std::shared_ptr<typename ServiceT::Response>)> callback);

  template<typename ServiceT>
  typename rclcpp::Client<ServiceT>::SharedPtr create_client(const std::string & name);

private:
  class RclcppMiddleware;
  using Turn = std::lock_guard<std::recursive_timed_mutex>;

  std::string visible_topic(const std::string & name);
  std::string resolved_topic(const std::string & name);
  std::string visible_service(const std::string & name);
  std::size_t slave_readers(const std::string & topic) const;
  std::shared_ptr<std::atomic<bool>> gate() const;
  Timer::SharedPtr add_timer(
    std::chrono::nanoseconds period, std::function<void()> callback, bool is_wall);
  void keep_parameters();
  void add_parameter_services();
  void store();

  /// Services of a node that rosrm has not started.
  std::vector<std::shared_ptr<void>> services_;
  /// Held while a callback runs, because the last snapshot is stored in the thread of a signal.
  std::recursive_timed_mutex turn_;
  std::unique_ptr<RclcppMiddleware> middleware_;
  std::unique_ptr<HandoffSession> session_;
  rclcpp::PreShutdownCallbackHandle at_shutdown_;
  rclcpp::Node::PostSetParametersCallbackHandle::SharedPtr parameters_set_;
  bool parameters_changed_ = true;
  std::size_t parameters_known_ = 0;
  /// Names of the parameters that were set, also from the state of a predecessor.
  std::set<std::string> set_at_run_time_;
};

// --- implementation ----------------------------------------------------------------------------

/// Return a message in CDR.
template<typename MessageT>
Bytes serialised(const MessageT & message)
{
  rclcpp::SerializedMessage buffer;
  rclcpp::Serialization<MessageT>().serialize_message(&message, &buffer);
  const auto & raw = buffer.get_rcl_serialized_message();
  return Bytes(raw.buffer, raw.buffer + raw.buffer_length);
}

/// Return rclcpp's form of a message in CDR.
rclcpp::SerializedMessage serialised_message(const Bytes & data);

/// Return a message from CDR.
template<typename MessageT>
MessageT deserialised(const Bytes & data)
{
  const auto buffer = serialised_message(data);
  MessageT message;
  rclcpp::Serialization<MessageT>().deserialize_message(&buffer, &message);
  return message;
}

/// Return time and order of a received message.
Sent sent_of(const rclcpp::MessageInfo & info);

/// Return true if an input needs every message, and not only the newest.
bool wants_all(const rclcpp::QoS & qos);

template<typename MessageT>
void Node::keep_state(
  const std::string & topic, std::function<std::optional<MessageT>()> save,
  std::function<void(const MessageT &)> restore)
{
  if (!session_) {
    return;
  }
  session_->keep_state(
    std::make_shared<StateTopic>(
      resolved_topic(topic), rosidl_generator_traits::name<MessageT>(),
      [save]() -> std::optional<Bytes> {
        const auto message = save();
        return message ? std::optional<Bytes>(serialised(*message)) : std::nullopt;
      },
      [restore](const Bytes & data) {restore(deserialised<MessageT>(data));}));
}

template<typename MessageT>
typename Publisher<MessageT>::SharedPtr Node::create_publisher(
  const std::string & topic, const rclcpp::QoS & qos)
{
  const auto plain = rclcpp::Node::create_publisher<MessageT>(visible_topic(topic), qos);
  if (session_) {
    auto output = std::make_shared<Output>();
    output->topic = plain->get_topic_name();
    output->subscriptions = [this, plain, readers = ReaderCount()]() mutable {
        return readers.of(
          plain->get_subscription_count(), [&] {return slave_readers(plain->get_topic_name());});
      };
    output->acknowledged = [plain] {
        return plain->wait_for_all_acked(std::chrono::nanoseconds(0));
      };
    session_->entities.add(std::move(output));
  }
  return std::make_shared<Publisher<MessageT>>(plain, gate());
}

template<typename MessageT>
typename rclcpp::Subscription<MessageT>::SharedPtr Node::create_subscription(
  const std::string & topic, const rclcpp::QoS & qos,
  std::function<void(const MessageT &)> callback, bool buffer)
{
  const std::string name = visible_topic(topic);
  if (!session_) {
    return rclcpp::Node::create_subscription<MessageT>(
      name, qos, [callback](const MessageT & message) {callback(message);});
  }
  const auto arrival = [callback](
    std::shared_ptr<const MessageT> message, const rclcpp::MessageInfo & info) {
      return Arrival{
        sent_of(info), [message] {return serialised(*message).size();},
        [message, callback] {callback(*message);}};
    };
  const auto input = std::make_shared<Input>();
  rclcpp::SubscriptionOptions options;
  // Otherwise messages of this process would come without time stamps and numbers.
  options.use_intra_process_comm = rclcpp::IntraProcessSetting::Disable;
  const auto plain = rclcpp::Node::create_subscription<MessageT>(
    name, qos, [this, input, arrival](
      std::shared_ptr<const MessageT> message, const rclcpp::MessageInfo & info) {
      const Turn turn(turn_);
      session_->entities.received(*input, arrival(message, info));
    }, options);
  const std::weak_ptr<rclcpp::Subscription<MessageT>> reader = plain;
  input->topic = plain->get_topic_name();
  input->buffered = buffer;
  input->wants_all = wants_all(qos);
  input->depth = qos.history() == rclcpp::HistoryPolicy::KeepLast ? qos.depth() : 0;
  input->publishers = [reader] {
      const auto subscription = reader.lock();
      return subscription ? static_cast<std::uint32_t>(subscription->get_publisher_count()) : 0u;
    };
  input->take_waiting = [this, reader, arrival, key = input.get()] {
      const auto subscription = reader.lock();
      auto message = std::make_shared<MessageT>();
      rclcpp::MessageInfo info;
      while (subscription && subscription->take(*message, info)) {
        session_->entities.keep(*key, arrival(message, info));
        message = std::make_shared<MessageT>();
      }
    };
  session_->entities.add(input);
  return plain;
}

/// A server that holds the requests of a silent node until it resumes.
template<typename ServiceT>
struct HeldService
{
  using Request = std::shared_ptr<typename ServiceT::Request>;
  using Response = std::shared_ptr<typename ServiceT::Response>;
  using Header = std::shared_ptr<rmw_request_id_t>;

  std::function<void(Request, Response)> callback;
  typename rclcpp::Service<ServiceT>::SharedPtr plain;
  std::deque<std::pair<Header, Request>> held;

  void answer(HandoffSession * session, Header header, Request request)
  {
    const auto response = std::make_shared<typename ServiceT::Response>();
    const auto call = [&] {callback(request, response);};
    if (session != nullptr) {
      session->entities.cycle(call);
    } else {
      call();
    }
    plain->send_response(*header, *response);
  }
};

template<typename ServiceT>
void Node::create_service(
  const std::string & name,
  std::function<void(
    std::shared_ptr<typename ServiceT::Request>,
    std::shared_ptr<typename ServiceT::Response>)> callback)
{
  using Held = HeldService<ServiceT>;
  const auto service = std::make_shared<Held>();
  service->callback = std::move(callback);
  const auto serve = [this, weak = std::weak_ptr<Held>(service)](
    typename Held::Header header, typename Held::Request request) {
      const Turn turn(turn_);
      const auto one = weak.lock();
      if (one && session_ && session_->entities.mode != Mode::kActive) {
        one->held.emplace_back(header, request);
      } else if (one) {
        one->answer(session_.get(), header, request);
      }
    };
  const auto open = [this, service, serve, visible = visible_service(name)] {
      service->plain = rclcpp::Node::create_service<ServiceT>(visible, serve);
    };
  if (!session_) {
    open();
    services_.push_back(service);
    return;
  }
  const auto opening = std::make_shared<Opening>();
  opening->is_service = true;
  opening->open = open;
  opening->close = [service] {
      service->held.clear();
      service->plain.reset();
    };
  opening->serve_held = [this, service] {
      if (service->held.empty()) {
        return false;
      }
      const auto [header, request] = service->held.front();
      service->held.pop_front();
      service->answer(session_.get(), header, request);
      return true;
    };
  session_->entities.add(opening);
}

template<typename ServiceT>
typename rclcpp::Client<ServiceT>::SharedPtr Node::create_client(const std::string & name)
{
  return rclcpp::Node::create_client<ServiceT>(visible_service(name));
}

}  // namespace rosrm_node
