#include "rosrm_node_cpp/node.hpp"

#include <algorithm>
#include <array>
#include <map>
#include <stdexcept>

#include "rcl_interfaces/msg/parameter_event.hpp"
#include "rclcpp/parameter_service.hpp"
#include "rosrm_msgs/msg/sealed.hpp"

namespace rosrm_node
{

namespace
{

using rcl_interfaces::msg::ParameterEvent;
using SealedMessage = rosrm_msgs::msg::Sealed;

/// Seconds that the last snapshot waits for a callback to end.
constexpr std::chrono::seconds kClosePatience{5};
constexpr std::array<const char *, 6> kParameterServices{
  "get_parameters", "get_parameter_types", "set_parameters", "set_parameters_atomically",
  "describe_parameters", "list_parameters"};

/// True while a migratable node exists in this process.
std::atomic<bool> & is_taken()
{
  static std::atomic<bool> taken{false};
  return taken;
}

/// Return options by which the parameter services have the names that peers know, without an alias,
/// and are created only when the node is active.
rclcpp::NodeOptions options_for(
  rclcpp::NodeOptions options, const std::optional<NodeIdentity> & identity)
{
  if (!identity) {
    return options;
  }
  auto arguments = options.arguments();
  arguments.push_back("--ros-args");
  for (const char * const service : kParameterServices) {
    arguments.push_back("-r");
    arguments.push_back(std::string("~/") + service + ":=" + identity->node + "/" + service);
  }
  arguments.push_back("--");
  return options.arguments(arguments).start_parameter_services(false);
}

/// Return options by which messages come through DDS, although the author's node may have others:
/// rclcpp's intra-process communication refuses serialised messages.
template<typename OptionsT>
OptionsT through_dds()
{
  OptionsT options;
  options.use_intra_process_comm = rclcpp::IntraProcessSetting::Disable;
  return options;
}

rclcpp::QoS latched(std::size_t depth)
{
  return rclcpp::QoS(rclcpp::KeepLast(depth)).reliable().transient_local();
}

Bytes bytes_of(const rclcpp::SerializedMessage & message)
{
  const auto & raw = message.get_rcl_serialized_message();
  return Bytes(raw.buffer, raw.buffer + raw.buffer_length);
}

}  // namespace

rclcpp::SerializedMessage serialised_message(const Bytes & data)
{
  rclcpp::SerializedMessage message(data.size());
  auto & raw = message.get_rcl_serialized_message();
  std::copy(data.begin(), data.end(), raw.buffer);
  raw.buffer_length = data.size();
  return message;
}

Sent sent_of(const rclcpp::MessageInfo & info)
{
  const auto & plain = info.get_rmw_message_info();
  const std::uint64_t number = plain.publication_sequence_number;
  const bool is_known = number != RMW_MESSAGE_INFO_SEQUENCE_NUMBER_UNSUPPORTED;
  return {plain.source_timestamp, is_known ? number : 0};
}

bool wants_all(const rclcpp::QoS & qos)
{
  if (qos.reliability() == rclcpp::ReliabilityPolicy::BestEffort) {
    return false;
  }
  return qos.history() == rclcpp::HistoryPolicy::KeepAll || qos.depth() > 1;
}

// --- the middleware of the core ----------------------------------------------------------------

class Node::RclcppMiddleware : public Middleware
{
public:
  explicit RclcppMiddleware(Node & node)
  : node_(node) {}

  double now() override
  {
    const auto since = std::chrono::steady_clock::now().time_since_epoch();
    return std::chrono::duration<double>(since).count();
  }

  void wake_in(double seconds) override
  {
    const std::chrono::nanoseconds delay(static_cast<std::int64_t>(seconds * 1e9));
    wake_ = node_.rclcpp::Node::create_wall_timer(
      delay, [this] {
        const Turn turn(node_.turn_);
        wake_->cancel();  // it runs once; the core orders the next one
        node_.session_->wake();
      });
  }

  bool is_shut_down() override
  {
    return !node_.get_node_base_interface()->get_context()->is_valid();
  }

  void log(Severity severity, const std::string & text) override
  {
    if (severity == Severity::kError) {
      RCLCPP_ERROR(node_.get_logger(), "%s", text.c_str());
    } else if (severity == Severity::kWarning) {
      RCLCPP_WARN(node_.get_logger(), "%s", text.c_str());
    } else {
      RCLCPP_INFO(node_.get_logger(), "%s", text.c_str());
    }
  }

  int open_writer(const std::string & topic, std::size_t depth) override
  {
    writers_[++last_] =
      node_.rclcpp::Node::create_publisher<SealedMessage>(
      topic, latched(depth), through_dds<rclcpp::PublisherOptions>());
    return last_;
  }

  int open_reader(const std::string & topic, std::size_t depth) override
  {
    const int number = ++last_;
    readers_[number] = node_.rclcpp::Node::create_subscription<SealedMessage>(
      topic, latched(depth),
      [this, number](std::shared_ptr<const rclcpp::SerializedMessage> message) {
        const Turn turn(node_.turn_);
        node_.session_->received(number, bytes_of(*message));
      }, through_dds<rclcpp::SubscriptionOptions>());
    return number;
  }

  void close(int entity) override
  {
    writers_.erase(entity);
    readers_.erase(entity);
  }

  void publish(int writer, const Bytes & message) override
  {
    writers_.at(writer)->publish(serialised_message(message));
  }

  std::optional<Bytes> take(int reader) override
  {
    rclcpp::SerializedMessage message;
    rclcpp::MessageInfo info;
    if (!readers_.at(reader)->take_serialized(message, info)) {
      return std::nullopt;
    }
    return bytes_of(message);
  }

private:
  Node & node_;
  rclcpp::TimerBase::SharedPtr wake_;
  std::map<int, rclcpp::Publisher<SealedMessage>::SharedPtr> writers_;
  std::map<int, rclcpp::Subscription<SealedMessage>::SharedPtr> readers_;
  int last_ = 0;
};

// --- timers ------------------------------------------------------------------------------------

void Timer::cancel()
{
  first_.reset();
  plain_->cancel();
}

void Timer::reset()
{
  first_.reset();
  plain_->reset();
}

bool Timer::is_canceled() const
{
  return plain_->is_canceled() && !first_;
}

/// Return the nanoseconds until the timer is due; -1: it is cancelled.
std::int64_t Timer::due() const
{
  if (is_canceled()) {
    return -1;
  }
  const auto & next = first_ ? first_ : plain_;
  return std::max<std::int64_t>(0, next->time_until_trigger().count());
}

/// Start the timer: first run after some nanoseconds, at most a period; then with its period.
void Timer::start_in(rclcpp::Node & node, std::int64_t nanoseconds)
{
  if (nanoseconds >= period_.count()) {
    reset();
    return;
  }
  plain_->cancel();
  first_ = node.create_wall_timer(
    std::chrono::nanoseconds(nanoseconds), [weak = weak_from_this()] {
      const auto timer = weak.lock();  // the author may release the timer in its callback
      if (timer && timer->first_) {
        std::exchange(timer->first_, nullptr)->cancel();
        timer->plain_->reset();
        timer->tick_();
      }
    });
}

// --- the node ----------------------------------------------------------------------------------

Node::Node(const std::string & name, const rclcpp::NodeOptions & options)
: rclcpp::Node(name, options_for(options, identity_from(process_environment())))
{
  const auto identity = identity_from(process_environment());
  if (!identity) {
    return;
  }
  if (is_taken().exchange(true)) {
    throw std::runtime_error(
            "rosrm moves a process by one node, and another one is it already: make the others of "
            "this process rclcpp's nodes, or run each in a process of its own");
  }
  middleware_ = std::make_unique<RclcppMiddleware>(*this);
  session_ = std::make_unique<HandoffSession>(*middleware_, *identity);
  keep_parameters();
  if (options.start_parameter_services()) {
    add_parameter_services();
  }
  session_->begin();
  at_shutdown_ = get_node_base_interface()->get_context()->add_pre_shutdown_callback(
    [this] {store();});
}

Node::~Node()
{
  if (!session_) {
    return;
  }
  get_node_base_interface()->get_context()->remove_pre_shutdown_callback(at_shutdown_);
  const Turn turn(turn_);
  session_->close();  // stores nothing: the members of the author's class do not exist any more
  is_taken() = false;
}

/// Store the last snapshot at an orderly end, in the thread that shuts the context down.
void Node::store()
{
  // The wait is limited, because a callback of the author may be stuck.
  std::unique_lock<std::recursive_timed_mutex> turn(turn_, kClosePatience);
  if (turn.owns_lock()) {
    session_->store();
  }
}

void Node::when_active(std::function<std::shared_ptr<void>()> create)
{
  const auto made = std::make_shared<std::shared_ptr<void>>();
  if (!session_) {
    *made = create();
    services_.push_back(made);
    return;
  }
  const auto opening = std::make_shared<Opening>();
  opening->open = [made, create] {*made = create();};
  opening->close = [made] {made->reset();};
  session_->entities.add(opening);
}

std::string Node::visible_topic(const std::string & name)
{
  const std::string resolved = get_node_topics_interface()->resolve_topic_name(name);
  const std::string visible = session_ ?
    session_->entities.visible(resolved, get_fully_qualified_name()) : resolved;
  return visible == resolved ? name : visible;  // rcl applies remappings to the author's name
}

std::string Node::resolved_topic(const std::string & name)
{
  return get_node_topics_interface()->resolve_topic_name(visible_topic(name));
}

std::string Node::visible_service(const std::string & name)
{
  const std::string resolved = get_node_services_interface()->resolve_service_name(name);
  const std::string visible = session_ ?
    session_->entities.visible(resolved, get_fully_qualified_name()) : resolved;
  return visible == resolved ? name : visible;
}

std::size_t Node::slave_readers(const std::string & topic) const
{
  const auto readers = get_subscriptions_info_by_topic(topic);
  return std::count_if(
    readers.begin(), readers.end(), [](const auto & one) {
      return one.node_name().rfind("rosrm_slave_", 0) == 0;
    });
}

std::shared_ptr<std::atomic<bool>> Node::gate() const
{
  return session_ ? session_->entities.gate : nullptr;
}

Timer::SharedPtr Node::create_wall_timer(
  std::chrono::nanoseconds period, std::function<void()> callback)
{
  return add_timer(period, std::move(callback), true);
}

Timer::SharedPtr Node::create_timer(
  std::chrono::nanoseconds period, std::function<void()> callback)
{
  return add_timer(period, std::move(callback), false);
}

Timer::SharedPtr Node::add_timer(
  std::chrono::nanoseconds period, std::function<void()> callback, bool is_wall)
{
  const auto timer = std::make_shared<Timer>();
  timer->period_ = period;
  timer->tick_ = [this, callback = std::move(callback)] {
      const Turn turn(turn_);
      if (session_) {
        session_->entities.ticked(callback);
      } else {
        callback();
      }
    };
  const std::weak_ptr<Timer> weak = timer;
  const auto tick = [weak] {
      if (const auto alive = weak.lock()) {
        alive->tick_();
      }
    };
  if (is_wall) {
    timer->plain_ = rclcpp::Node::create_wall_timer(period, tick);
  } else {
    timer->plain_ = rclcpp::Node::create_timer(period, tick);
  }
  if (!session_) {
    return timer;
  }
  const auto one = std::make_shared<TimerOf>();
  one->due = [weak] {
      const auto alive = weak.lock();
      return alive ? alive->due() : -1;
    };
  one->start_in = [this, weak](std::int64_t nanoseconds) {
      if (const auto alive = weak.lock()) {
        alive->start_in(*this, nanoseconds);
      }
    };
  one->stop = [weak] {
      if (const auto alive = weak.lock()) {
        alive->cancel();
      }
    };
  one->follows_ros_time = [this, is_wall] {
      const auto clock = get_clock();  // rclcpp raises for a clock of another type
      return !is_wall && clock->get_clock_type() == RCL_ROS_TIME && clock->ros_time_is_active();
    };
  session_->entities.add(one);
  return timer;
}

/// Make the parameters a part of the state.
void Node::keep_parameters()
{
  parameters_set_ = add_post_set_parameters_callback(
    [this](const std::vector<rclcpp::Parameter> & parameters) {
      parameters_changed_ = true;
      for (const auto & parameter : parameters) {
        if (has_parameter(parameter.get_name())) {  // otherwise it is being declared
          set_at_run_time_.insert(parameter.get_name());
        }
      }
    });
  keep_state<ParameterEvent>(
    "~/_rosrm/parameters",
    [this]() -> std::optional<ParameterEvent> {
      const auto names = list_parameters({}, 0).names;
      if (!parameters_changed_ && names.size() == parameters_known_) {
        return std::nullopt;
      }
      parameters_changed_ = false;
      parameters_known_ = names.size();
      ParameterEvent event;
      event.node = get_fully_qualified_name();
      for (const auto & name : names) {
        rclcpp::Parameter parameter;
        if (get_parameter(name, parameter)) {  // false: declared, but never set
          const bool was_set = set_at_run_time_.count(name) > 0;
          auto & into = was_set ? event.changed_parameters : event.new_parameters;
          into.push_back(parameter.to_parameter_msg());
        }
      }
      return event;
    },
    [this](const ParameterEvent & event) {
      for (const auto & message : event.new_parameters) {  // declared ones may differ here
        const auto parameter = rclcpp::Parameter::from_parameter_msg(message);
        if (!has_parameter(parameter.get_name())) {
          declare_parameter(parameter.get_name(), parameter.get_parameter_value());
        }
      }
      std::vector<rclcpp::Parameter> differing;
      for (const auto & message : event.changed_parameters) {
        const auto parameter = rclcpp::Parameter::from_parameter_msg(message);
        if (parameter.get_type() == rclcpp::PARAMETER_NOT_SET) {
          continue;  // from a Python source of an earlier release
        }
        if (!has_parameter(parameter.get_name())) {
          declare_parameter(parameter.get_name(), parameter.get_parameter_value());
        }
        rclcpp::Parameter own;
        if (!get_parameter(parameter.get_name(), own) ||
        serialised(own.to_parameter_msg()) != serialised(message))
        {
          differing.push_back(parameter);
        }
      }
      if (differing.empty()) {
        return;  // rclcpp refuses an empty list
      }
      // In one call, because the values may be valid only together.
      const auto result = set_parameters_atomically(differing);
      if (!result.successful) {
        throw std::runtime_error("parameters cannot be set: " + result.reason);
      }
    });
}

/// Serve the parameters while this node is active. A request during a silence gets no answer,
/// because rclcpp's server would execute it.
void Node::add_parameter_services()
{
  when_active(
    [this]() -> std::shared_ptr<void> {
      return std::make_shared<rclcpp::ParameterService>(
        get_node_base_interface(), get_node_services_interface(),
        get_node_parameters_interface().get());
    });
}

}  // namespace rosrm_node
