#include "rosrm_node_cpp/core/destination.hpp"

#include <algorithm>
#include <utility>

#include "rosrm_node_cpp/core/cdr.hpp"

namespace rosrm_node
{

namespace
{

/// Seconds without a message after which an input counts as idle.
constexpr double kIdle = 1.0;
/// Seconds, from the matching of all peers, for which an input must not be behind the state. A
/// reliable reader that misses a message receives nothing until the next heartbeat of the writer,
/// every 3 s by default. The time is limited, because on a slow link an input may always be behind.
constexpr double kBehind = 5.0;
/// Seconds without a part or mark after which an ended source counts as drained.
constexpr double kQuiet = 0.2;
/// Seconds for which all readers have to be matched.
constexpr double kMatched = 1.5;
/// Seconds between two checks of the conditions that a shadow waits for.
constexpr double kReview = 0.1;
/// Seconds between two requests for a whole mark.
constexpr double kAsked = 0.5;
/// Most bytes of a message on the source's topics: a part of the state, sealed.
constexpr std::size_t kLargestMessage = kLargestPart + 1024;

}  // namespace

Destination::Destination(
  NodeEntities & entities, Readers & readers, StateTopics & parts, NodeLinks & links,
  std::string mark_topic, std::function<void()> activated)
: entities_(entities), readers_(readers), parts_(parts), links_(links),
  mark_topic_(std::move(mark_topic)), activated_(std::move(activated))
{
  entities.on_overflow = [this](const std::string & topic) {overflowed(topic);};
}

Destination::~Destination()
{
  unfollow();
}

// --- messages of the master --------------------------------------------------------------------

void Destination::configure(const StateConfig & config)
{
  if (!channel_) {
    open(config);
  } else {
    channel_->repeat();  // the request may come from a new master, after the first was lost
  }
  if (config.phase == Order::kDone) {
    close();
  } else if (ended_) {
    if (config.phase == Order::kAbort && !active_) {
      channel_->report(Phase::kAborted, sequence(), fault_);
    }
  } else if (config.phase == Order::kSwitch) {
    may_switch_ = true;
    review();
  } else if (config.phase == Order::kTakeOver) {
    alone_ = true;
    review();
  } else if (config.phase == Order::kAbort || config.phase == Order::kResume) {
    end(Phase::kAborted, "the master called it off");
  }
}

void Destination::open(const StateConfig & config)
{
  channel_ = std::make_unique<Channel>(
    entities_.middleware, readers_, links_, config, entities_.identity.instance, config.source, 0,
    [this](const HandoffReport & report) {take_report(report);});
  if (ended_) {
    channel_->report(Phase::kFailed, 0, fault_);
    return;
  }
  assembler_.emplace();
  // Marks first, also in `catch_up`, because they name the parts to store.
  follow(
    channel_->topic(kMarkType, mark_topic_), kMarkDepth,
    [this](const Bytes & data) {take_mark(data);});
  for (const auto & part : parts_) {
    follow_part(*part);
  }
  if (!ended_) {
    alarm_ = entities_.alarms.start(kReview, [this] {look();});
    review();
  }
}

void Destination::follow_part(const StateTopic & part)
{
  if (!assembler_ || !channel_) {
    return;
  }
  const std::string topic = part.topic();
  assembler_->expect(topic);
  follow(
    channel_->topic(part.type(), topic), kStateFollowedDepth,
    [this, topic](const Bytes & data) {
      if (assembler_) {
        assembler_->add_part(topic, data);
      }
    });
}

void Destination::follow(
  SealedTopic topic, std::size_t depth, std::function<void(const Bytes &)> take)
{
  if (ended_) {
    return;
  }
  const std::string name = topic.name();
  auto take_genuine =
    [shared = std::make_shared<SealedTopic>(std::move(topic)), take](const Bytes & data) {
      const auto plain = data.size() <= kLargestMessage ? shared->open(data) : std::nullopt;
      if (plain) {
        take(*plain);
      }
      return plain.has_value();
    };
  try {
    const int reader = entities_.middleware.open_reader(name, depth);
    readers_[reader] = [this, take_genuine](const Bytes & data) {came(take_genuine, data);};
    followed_.push_back({reader, take_genuine});
  } catch (const std::exception & error) {
    // An entity of the author may have another type on that topic.
    end(Phase::kFailed, name + " cannot be followed: " + error.what());
  }
}

// --- messages of the source --------------------------------------------------------------------

void Destination::take_report(const HandoffReport & report)
{
  if (ended_) {
    return;
  }
  if (report.phase == Phase::kAttached) {
    attached_ = true;
  } else if (report.phase == Phase::kSilent) {
    silent_at_ = report.sequence;
  } else if (report.phase == Phase::kFailed) {
    end(Phase::kFailed, "the source failed: " + report.message);
  }
  go_on();
}

void Destination::came(const std::function<bool(const Bytes &)> & take, const Bytes & data)
{
  if (ended_) {
    return;
  }
  const bool is_genuine = take(data);
  if (catch_up() || is_genuine) {
    last_report_ = entities_.middleware.now();
    go_on();
  }
}

/// Process all received messages; return true if one of them is genuine. With one message a round,
/// a shadow would lag behind a fast source.
bool Destination::catch_up()
{
  bool any_genuine = false;
  for (std::size_t index = 0; index < followed_.size(); ++index) {  // at the end it is cleared
    const Followed followed = followed_[index];
    while (!ended_) {
      const auto data = entities_.middleware.take(followed.reader);
      if (!data) {
        break;
      }
      any_genuine = followed.take(*data) || any_genuine;
    }
  }
  return any_genuine;
}

void Destination::take_mark(const Bytes & data)
{
  StateMark mark;
  try {
    mark = decoded_mark(data);
  } catch (const Malformed &) {
    return;
  }
  const std::string fault = fault_of(mark);
  if (!fault.empty()) {
    end(Phase::kFailed, fault);
  } else if (assembler_) {
    run_ = mark.run;
    if (!assembler_->add_mark(std::move(mark), entities_.middleware.now())) {
      end(Phase::kFailed, "too many marks came without the state they name");
    }
  }
}

/// Return the reason why this node cannot use the source's state; "" if it can.
std::string Destination::fault_of(const StateMark & mark) const
{
  if (mark.protocol_version != kProtocolVersion) {
    return "the source speaks protocol version " + std::to_string(mark.protocol_version) +
           ", this node " + std::to_string(kProtocolVersion) +
           ": both need the same version of rosrm";
  }
  if (run_ != 0 && mark.run != run_) {
    return "the source was started again, and its state is a new one";
  }
  const std::string fault = size_fault(mark);
  if (!fault.empty()) {
    return fault;
  }
  const std::string differing = differing_part(parts_, mark);
  return differing.empty() ? "" :
         "the state on " + differing + ": both must be the same program";
}

// --- following ---------------------------------------------------------------------------------

void Destination::look()
{
  if (!ended_ && !was_ready_) {
    entities_.catch_up();  // messages that wait in a reader have arrived, too
  }
  review();
  if (!ended_ && cut_) {
    ask_for_history();
  }
}

/// Restore the newest state, if there is a new one, then check the next step.
void Destination::go_on()
{
  if (ended_ || !assembler_) {
    return;
  }
  auto cut = assembler_->take();
  if (cut && !restore(std::move(*cut))) {
    return;
  }
  review();
}

bool Destination::restore(Cut cut)
{
  try {
    for (const auto & part : parts_) {
      part->restore_changed(cut.parts.at(part->topic()));
    }
  } catch (const StateError & error) {
    end(Phase::kFailed, error.what());
    return false;
  }
  cut.parts.clear();
  for (const auto & mark : cut.passed) {
    entities_.cover(mark.inputs);
  }
  entities_.cover(cut.mark.inputs);
  cut_ = std::move(cut);
  return !has_lost_history();
}

/// Fail if it is unknown which messages of an input the source has processed.
bool Destination::has_lost_history()
{
  const std::string topic = entities_.input_known(Known::kLost);
  if (!topic.empty()) {
    end(
      Phase::kFailed,
      "more than " + std::to_string(kHistory) + " messages came on " + topic + ", which has "
      "several publishers, while no mark of the source came, so it is not known which of them the "
      "source has processed");
  }
  return !topic.empty();
}

/// Repeat the last report if marks are missing: the source answers with a whole one.
void Destination::ask_for_history()
{
  const double now = entities_.middleware.now();
  if (channel_ && now - asked_at_ >= kAsked && !entities_.input_known(Known::kGap).empty()) {
    asked_at_ = now;
    channel_->repeat();
  }
}

/// Fail if marks are missing that may cover a message in the buffer.
bool Destination::is_unsure()
{
  const std::string topic = entities_.input_known(Known::kGap);
  if (!topic.empty()) {
    end(
      Phase::kFailed,
      "marks of the source are missing, so it is not known which messages on " + topic + " the "
      "source has processed");
  }
  return !topic.empty();
}

/// Report progress, request silence when allowed, and become active after it.
void Destination::review()
{
  if (!channel_ || ended_) {
    return;
  }
  if (alone_) {
    take_over_when_quiet();
    return;
  }
  if (!was_ready_) {
    const std::string missing = still_missing();
    if (!missing.empty()) {
      channel_->report(Phase::kShadowing, sequence(), "waits " + missing);
      return;
    }
    was_ready_ = true;
    channel_->report(Phase::kReady, sequence());
  }
  if (!may_switch_) {
    return;
  }
  if (is_last()) {
    activate_if_complete();
  } else {
    entities_.buffer.is_last = true;
    channel_->report(Phase::kSwitching, sequence());
  }
}

/// Return true for the last state of this handoff; an earlier one may be latched too.
bool Destination::is_last() const
{
  return cut_ && cut_->mark.last && silent_at_ && cut_->mark.sequence == *silent_at_;
}

std::uint64_t Destination::sequence() const
{
  return cut_ ? cut_->mark.sequence : 0;
}

/// Return the condition that this node waits for before it is ready; "" if it is ready.
std::string Destination::still_missing()
{
  if (!attached_) {
    return "for the source to answer: is it up, and does it use rosrm.node?";
  }
  if (!cut_) {
    return missing_state();
  }
  const double now = entities_.middleware.now();
  const std::string missing = missing_peers();
  if (!missing.empty()) {
    matched_at_.reset();
    return missing;
  }
  matched_at_ = std::min(matched_at_.value_or(now), now);
  if (now - *matched_at_ < kMatched) {
    return "a moment: its peers may not know it yet";
  }
  for (const auto & input : cut_->mark.inputs) {
    const std::string missing_here = missing_input(input.topic, now);
    if (!missing_here.empty()) {
      return missing_here;
    }
  }
  const std::string lossy = entities_.input_with_gap();
  if (!lossy.empty()) {
    return "until the state covers a message on " + lossy + " that did not arrive here";
  }
  const std::string unknown = entities_.input_known(Known::kGap);
  return unknown.empty() ? "" :
         "for a mark that names all messages on " + unknown + " that the source has processed";
}

/// Return the topic and number of peers matched with the source but not with this node.
std::string Destination::missing_peers() const
{
  for (const auto & theirs : cut_->mark.outputs) {
    for (const auto & output : entities_.outputs) {
      if (output->topic == theirs.topic && output->subscriptions() < theirs.subscriptions) {
        return "for the readers of " + theirs.topic + ": " +
               std::to_string(output->subscriptions()) + " of " +
               std::to_string(theirs.subscriptions) + " matched";
      }
    }
  }
  for (const auto & theirs : cut_->mark.inputs) {
    for (const auto & input : entities_.inputs) {
      if (input->key == theirs.topic && input->publishers() < theirs.publishers) {
        return "for the publishers of " + theirs.topic + ": " +
               std::to_string(input->publishers()) + " of " +
               std::to_string(theirs.publishers) + " matched";
      }
    }
  }
  return "";
}

std::string Destination::missing_state() const
{
  const auto missing = assembler_ ? assembler_->missing() : std::vector<std::string>{};
  if (missing.empty()) {
    return "for the first state, marked on " + mark_topic_;
  }
  std::string topics;
  for (const auto & topic : missing) {
    topics += (topics.empty() ? "" : ", ") + topic;
  }
  return "for the state on " + topics;
}

/// Return the condition of an input that this node waits for; "" if there is none. Each message must
/// be in the buffer or covered by the state, and the newest covered one must have arrived.
std::string Destination::missing_input(const std::string & key, double now)
{
  const bool is_own = std::any_of(
    entities_.inputs.begin(), entities_.inputs.end(), [&key](const auto & input) {
      return input->key == key;
    });
  InputBuffer & buffer = entities_.buffer;
  if (!is_own || buffer.is_idle(key, now, *matched_at_, kIdle)) {
    return "";
  }
  if (!buffer.overlaps(key)) {
    return "until a message on " + key + " has been here and in the state";
  }
  if (buffer.is_behind(key) && now - *matched_at_ < kBehind) {
    return "until the newest message on " + key + " in the state has been here";
  }
  return "";
}

// --- the end -----------------------------------------------------------------------------------

/// Become active after the source's end, when its last messages have arrived.
void Destination::take_over_when_quiet()
{
  if (entities_.middleware.now() - last_report_ < kQuiet) {
    return;
  }
  if (!cut_) {
    end(Phase::kFailed, "the source ended before a state of it was here");
  } else if (!is_unsure()) {
    activate();
  }
}

void Destination::activate_if_complete()
{
  entities_.catch_up();
  const std::string lossy = entities_.input_with_gap();
  if (!lossy.empty()) {
    end(
      Phase::kFailed,
      "a message on " + lossy + " did not arrive here, and the source has not processed it: its "
      "subscription needs a greater depth, or this host is too busy");
  } else if (!ended_ && !is_unsure()) {
    activate();
  }
}

void Destination::activate()
{
  if (!cut_ || held_) {
    return;
  }
  ended_ = active_ = true;
  entities_.sequence = sequence();
  entities_.inherit(cut_->mark.inputs);
  const auto announce = [this] {
      if (channel_) {
        channel_->report(Phase::kActive, sequence());
      }
    };
  // Buffered messages are served first, because `unfollow` and `activated` take time.
  entities_.become_active(
    cut_->mark.timers_due, cut_->arrived, announce, {[this] {unfollow();}, activated_});
}

/// Abandon the handoff for good; this process then runs until its slave stops it.
void Destination::end(Phase phase, const std::string & message)
{
  ended_ = true;
  fault_ = message;
  entities_.middleware.log(
    Severity::kWarning, "this instance will not take over: " + message);
  if (channel_) {
    channel_->report(phase, sequence(), message);
  }
  unfollow();
}

void Destination::overflowed(const std::string & topic)
{
  if (!ended_) {
    end(
      Phase::kFailed,
      "more came on " + topic + " than can be kept until the source's state covers it");
  }
}

void Destination::unfollow()
{
  for (const auto & followed : std::exchange(followed_, {})) {
    readers_.erase(followed.reader);
    entities_.middleware.close(followed.reader);
  }
  entities_.alarms.stop(alarm_);
  assembler_.reset();
  cut_.reset();
}

void Destination::close()
{
  channel_.reset();
}

}  // namespace rosrm_node
