#include "rosrm_node_cpp/core/handoff_source.hpp"

#include <algorithm>
#include <random>
#include <utility>

namespace rosrm_node
{

namespace
{

/// Seconds that a silent source waits until its last outputs are acknowledged.
constexpr double kAckPatience = 4.0;
/// Seconds between two checks for acknowledgements.
constexpr double kLook = 0.05;
/// Seconds between the closing of two services, because each one is announced to every participant.
constexpr double kCloseEvery = 0.02;
/// Most seconds that a source waits for the end of a cycle before it becomes silent. Right after a
/// cycle, the time until the next periodic input is longest.
constexpr double kCyclePatience = 0.1;

std::uint64_t random_number()
{
  std::random_device device;
  return (static_cast<std::uint64_t>(device()) << 31 ^ device()) | 1u;
}

}  // namespace

HandoffSource::HandoffSource(
  NodeEntities & entities, Readers & readers, StateTopics & parts, NodeLinks & links,
  std::string mark_topic, double ask_every)
: entities_(entities), readers_(readers), parts_(parts), links_(links),
  mark_topic_(std::move(mark_topic)), ask_every_(ask_every), run_(random_number())
{
  if (!entities.identity.keep.empty()) {
    saver_.emplace(entities, parts, run_);
  }
  entities.on_cycle = [this] {after_cycle();};
  entities.on_overflow = [this](const std::string & topic) {overflowed(topic);};
}

HandoffSource::~HandoffSource()
{
  call_off();
  ask_no_more();
  entities_.alarms.stop(closing_alarm_);
}

// --- the state ---------------------------------------------------------------------------------

void HandoffSource::add_part(StateTopic & part)
{
  if (channel_) {
    show_part(part);
  }
}

void HandoffSource::show_part(StateTopic & part)
{
  try {
    states_.push_back(
      std::make_unique<SealedWriter>(
        entities_.middleware, channel_->topic(part.type(), part.topic()), kStateDepth));
    part.show_to([writer = states_.back().get()](const Bytes & data) {writer->publish(data);});
  } catch (const std::exception & error) {
    // An entity of the author may have another type on that topic.
    failed(part.topic() + " cannot be published: " + error.what());
  }
}

void HandoffSource::after_cycle()
{
  if (attached_ && fault_.empty()) {
    show();
  }
  if (saver_) {
    saver_->after_cycle();
  }
  if (cycle_alarm_ != 0 && !entities_.is_replaying()) {  // it counts between two cycles
    finish();
  }
}

/// Publish the state between two cycles, and its mark. Return false on a failure, which has been
/// reported to the master.
bool HandoffSource::show(bool is_whole, bool last)
{
  try {
    for (const auto & part : parts_) {
      part->publish();
    }
  } catch (const StateError & error) {
    failed(error.what());
    return false;
  }
  if (marks_) {
    marks_->publish(encoded(mark(is_whole, last)));
  }
  return true;
}

/// Publish a whole mark of the newest published state, for a follower that missed marks.
void HandoffSource::show_history()
{
  const bool is_ready = attached_ && fault_.empty() && entities_.mode == Mode::kActive;
  if (!is_ready || !marks_ || entities_.in_cycle) {
    return;
  }
  for (const auto & part : parts_) {
    part->show();
  }
  marks_->publish(encoded(mark(true, false)));
}

/// Report that the state cannot be published; the handoff fails, the node stays active.
void HandoffSource::failed(const std::string & fault)
{
  if (fault_.empty()) {
    entities_.middleware.log(Severity::kError, fault + ". This node stays where it is");
  }
  fault_ = fault;
  report(Phase::kFailed, fault);
}

StateMark HandoffSource::mark(bool is_whole, bool last)
{
  StateMark mark;
  mark.run = run_;
  mark.sequence = entities_.sequence;
  mark.last = last;
  for (const auto & part : parts_) {
    mark.parts.push_back(part->described());
  }
  mark.inputs = entities_.covered_inputs(is_whole);
  for (const auto & output : entities_.outputs) {
    mark.outputs.push_back({output->topic, output->subscriptions()});
  }
  mark.timers_due = last ? still_due() : entities_.timers_due();
  return mark;
}

/// Return the timers' due times less the time that saving a large state has taken.
std::vector<std::int64_t> HandoffSource::still_due()
{
  const auto passed =
    static_cast<std::int64_t>((entities_.middleware.now() - silent_since_) * 1e9);
  auto due = timers_due_;
  for (auto & one : due) {
    one = one < 0 ? one : std::max<std::int64_t>(0, one - passed);
  }
  return due;
}

void HandoffSource::report(Phase phase, const std::string & message)
{
  if (channel_) {
    channel_->report(phase, entities_.sequence, message);
  }
}

// --- a handoff ---------------------------------------------------------------------------------

void HandoffSource::configure(const StateConfig & config)
{
  // Anyone may have recorded messages for an earlier run of this node, and they still open. So only
  // messages with the number of this run make the node silent, and a silent node ignores others.
  const bool is_of_this_run = config.source_run == run_;
  const bool is_silent = finishing_ || entities_.mode == Mode::kSilent;
  if (is_silent && !is_of_this_run) {
    return;
  }
  if (!channel_ || channel_->name != config.channel) {
    if (config.phase != Order::kShadow && config.phase != Order::kSwitch &&
      config.phase != Order::kResume)
    {
      return;
    }
    open(config);
  } else {
    channel_->repeat();
  }
  if (config.phase == Order::kSwitch && is_of_this_run) {
    may_switch_ = true;
    switch_over();
  } else if (config.phase == Order::kResume) {
    resume();
  } else if (config.phase == Order::kDone) {
    close();
  }
}

void HandoffSource::open(const StateConfig & config)
{
  close();
  channel_ = std::make_unique<Channel>(
    entities_.middleware, readers_, links_, config, entities_.identity.instance,
    config.destination, run_, [this](const HandoffReport & report) {take_report(report);});
  marks_ = std::make_unique<SealedWriter>(
    entities_.middleware, channel_->topic(kMarkType, mark_topic_), kMarkDepth);
  for (const auto & part : parts_) {
    show_part(*part);
  }
}

void HandoffSource::take_report(const HandoffReport & report)
{
  if (report.phase == Phase::kShadowing || report.phase == Phase::kReady) {
    show_history();
    attach();
  } else if (report.phase == Phase::kSwitching) {
    asked_ = true;
    switch_over();
  } else if (report.phase == Phase::kActive && entities_.mode == Mode::kSilent) {
    close_services();
  }
}

/// Close one service now, and the others one by one.
void HandoffSource::close_services()
{
  if (closing_alarm_ == 0) {
    closing_alarm_ = entities_.alarms.start(kCloseEvery, [this] {close_next_service();});
    close_next_service();
  }
}

void HandoffSource::close_next_service()
{
  if (entities_.mode != Mode::kSilent || !entities_.close_next_service()) {
    entities_.alarms.stop(closing_alarm_);
  }
}

void HandoffSource::attach()
{
  if (!channel_ || attached_ || !fault_.empty()) {
    return;
  }
  attached_ = true;
  if (show(true)) {
    report(Phase::kAttached);
  }
}

/// Fall silent after the next cycle, once master and destination have requested it.
void HandoffSource::switch_over()
{
  if (!channel_ || !(may_switch_ && asked_) || !fault_.empty()) {
    return;
  }
  if (entities_.mode == Mode::kActive && !finishing_) {
    finishing_ = true;
    cycle_alarm_ = entities_.alarms.start(kCyclePatience, [this] {finish();});
  }
}

/// Serve received messages and fall silent.
void HandoffSource::finish()
{
  entities_.alarms.stop(cycle_alarm_);
  entities_.serve_what_has_come([this] {fall_silent();});
}

void HandoffSource::fall_silent()
{
  const bool is_wanted = std::exchange(finishing_, false);
  if (!channel_ || !is_wanted || !fault_.empty()) {
    return;  // the handoff was aborted
  }
  timers_due_ = entities_.fall_silent();
  silent_since_ = entities_.middleware.now();
  if (!show(true, true)) {
    reactivate([] {});  // the failure has been reported
    return;
  }
  silent_for_ = channel_->destination;
  ask_alarm_ = entities_.alarms.start(ask_every_, [this] {ask();});
  report(Phase::kSilent);
  release_alarm_ = entities_.alarms.start(kLook, [this] {release();});
}

/// Report that all outputs are acknowledged, or that the time for it has passed. An output without
/// an acknowledgement is lost when the process stops.
void HandoffSource::release()
{
  const bool is_received = std::all_of(
    entities_.outputs.begin(), entities_.outputs.end(), [](const auto & output) {
      return output->acknowledged();
    });
  if (is_received || entities_.middleware.now() - silent_since_ >= kAckPatience) {
    entities_.alarms.stop(release_alarm_);
    report(Phase::kReleased);
  }
}

void HandoffSource::call_off()
{
  may_switch_ = asked_ = attached_ = finishing_ = false;
  entities_.alarms.stop(cycle_alarm_);
  entities_.alarms.stop(release_alarm_);
}

void HandoffSource::resume()
{
  call_off();
  const auto announce = [this] {report(Phase::kResumed);};
  if (entities_.mode == Mode::kSilent) {
    reactivate(announce);
  } else {
    announce();
  }
}

void HandoffSource::reactivate(const std::function<void()> & announce)
{
  ask_no_more();
  entities_.become_active(timers_due_, silent_since_, announce);
}

/// Ask the master if the node may resume: the source may be silent without a handoff.
void HandoffSource::ask()
{
  if (entities_.mode != Mode::kSilent) {
    return;
  }
  if (!questions_) {
    questions_ = std::make_unique<SealedWriter>(
      entities_.middleware, links_.questions, kReportDepth);
  }
  HandoffReport question;
  question.destination = silent_for_;
  question.instance = entities_.identity.instance;
  question.run = run_;
  question.phase = Phase::kSilent;
  question.sequence = entities_.sequence;
  questions_->publish(encoded(question));
}

void HandoffSource::ask_no_more()
{
  entities_.alarms.stop(ask_alarm_);
  questions_.reset();
}

void HandoffSource::overflowed(const std::string & topic)
{
  entities_.middleware.log(
    Severity::kError,
    "silent for its successor, and the buffer of " + topic + " is full: a message is lost");
}

void HandoffSource::close()
{
  fault_.clear();
  call_off();
  for (const auto & part : parts_) {
    part->show_to([](const Bytes &) {});
  }
  states_.clear();
  marks_.reset();
  channel_.reset();
}

void HandoffSource::end()
{
  ask_no_more();
  if (saver_) {
    saver_->close();
  }
}

}  // namespace rosrm_node
