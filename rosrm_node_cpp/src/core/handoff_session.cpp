#include "rosrm_node_cpp/core/handoff_session.hpp"

#include <stdexcept>
#include <utility>

#include "rosrm_node_cpp/core/cdr.hpp"

namespace rosrm_node
{

namespace
{

constexpr const char * kMarkPath = "_rosrm/mark";
/// Most reasons for refusals that are logged, each once, and the most letters of a name in one.
constexpr std::size_t kMostReasons = 16;
constexpr std::size_t kLongestName = 64;
/// Epochs by which one message may be ahead, where the slave does not say which is the newest.
constexpr std::uint64_t kEpochStep = 1000;
/// Most messages that are held.
constexpr std::size_t kMostHeld = 16;
/// Seconds between two looks if the slave knows the epoch.
constexpr double kEarlyLook = 0.1;
/// Seconds for the author's constructor to name all parts, if it spins first; check interval.
constexpr double kConstructorPatience = 10.0;
constexpr double kConstructorLook = 0.02;
/// Oldest protocol version whose snapshots have the same content.
constexpr std::uint16_t kOldestRead = 5;

FoundSnapshot found_snapshot(const NodeIdentity & identity)
{
  if (identity.shadow || identity.keep.empty()) {
    return {};
  }
  return newest_snapshot(identity.keep, identity.instance);
}

template<typename T>
void push_bounded(std::deque<T> & queue, T value)
{
  queue.push_back(std::move(value));
  if (queue.size() > kMostHeld) {
    queue.pop_front();
  }
}

}  // namespace

HandoffSession::HandoffSession(
  Middleware & middleware, const NodeIdentity & identity, const Patience & patience)
: entities(middleware, identity, identity.shadow), patience_(patience), links_(identity),
  epoch_(identity.epoch)
{
  auto found = found_snapshot(identity);
  snapshot_ = std::move(found.snapshot);
  damaged_ = std::move(found.faults);
  if (snapshot_) {
    entities.mode = Mode::kShadow;
    *entities.gate = false;
  }
}

HandoffSession::~HandoffSession()
{
  destination_.reset();
  source_.reset();
}

void HandoffSession::begin()
{
  Middleware & middleware = entities.middleware;
  for (const auto & fault : damaged_) {
    middleware.log(Severity::kWarning, "ignoring a damaged snapshot: " + fault);
  }
  if (entities.identity.shadow) {
    destination_ = std::make_unique<Destination>(
      entities, readers_, parts_, links_, own(kMarkPath), [this] {become_source();});
  } else if (snapshot_) {
    give_up_ = middleware.now() + kConstructorPatience;
    restore_alarm_ = entities.alarms.start(0.0, [this] {restore_snapshot();});
  } else {
    become_source();
  }
  reader_ = middleware.open_reader(entities.identity.state_config, kConfigDepth);
  readers_[reader_] = [this](const Bytes & data) {take_config(data);};
}

std::string HandoffSession::own(const std::string & path) const
{
  return entities.identity.node + "/" + path;
}

void HandoffSession::become_source()
{
  source_ = std::make_unique<HandoffSource>(
    entities, readers_, parts_, links_, own(kMarkPath), patience_.ask_every);
  while (!before_source_.empty()) {
    const StateConfig config = std::move(before_source_.front());
    before_source_.pop_front();
    configured(config);
  }
}

void HandoffSession::keep_state(std::shared_ptr<StateTopic> part)
{
  for (const auto & other : parts_) {
    if (other->topic() == part->topic()) {
      throw std::invalid_argument(
              "keep_state: " + part->topic() +
              " is named twice; each part has a topic of its own");
    }
  }
  parts_.push_back(std::move(part));
  if (source_) {
    source_->add_part(*parts_.back());
  } else if (destination_) {
    destination_->follow_part(*parts_.back());
  }
}

void HandoffSession::received(int reader, const Bytes & data)
{
  const auto found = readers_.find(reader);
  if (found != readers_.end()) {
    const auto take = found->second;  // the call may close the subscription
    take(data);
  }
}

// --- snapshots ---------------------------------------------------------------------------------

void HandoffSession::restore_snapshot()
{
  entities.alarms.stop(restore_alarm_);
  const bool is_incomplete = parts_.size() + 1 < snapshot_->blocks.size();
  if (is_incomplete && entities.middleware.now() < give_up_) {
    restore_alarm_ = entities.alarms.start(kConstructorLook, [this] {restore_snapshot();});
    return;
  }
  StateMark mark;
  try {
    mark = restored(*snapshot_);
  } catch (const std::exception & fault) {
    const std::string text =
      "the snapshot " + snapshot_->path + " cannot be restored: " + fault.what();
    entities.middleware.log(
      Severity::kError,
      text + ". The node does not start, so that the snapshot is not overwritten. To start "
      "without it, cancel the process and submit it again");
    throw StateError(text);
  }
  const std::string origin =
    snapshot_->process + "#" + std::to_string(snapshot_->instance) + ", cycle " +
    std::to_string(snapshot_->sequence);
  snapshot_.reset();
  entities.sequence = mark.sequence;
  entities.cover(mark.inputs);
  entities.inherit(mark.inputs);
  entities.become_active(
    mark.timers_due, entities.middleware.now(), [this, &origin] {
      entities.middleware.log(Severity::kInfo, "continues from the snapshot of " + origin);
    });
  become_source();
}

StateMark HandoffSession::restored(const Snapshot & snapshot)
{
  const StateMark mark = decoded_mark(snapshot.blocks.front());
  const std::string fault = fault_of(mark, snapshot);
  if (!fault.empty()) {
    throw StateError(fault);
  }
  for (const auto & part : parts_) {
    for (std::size_t index = 0; index < mark.parts.size(); ++index) {
      if (mark.parts[index].topic == part->topic()) {
        part->restore_changed(snapshot.blocks[index + 1]);
      }
    }
  }
  return mark;
}

std::string HandoffSession::fault_of(const StateMark & mark, const Snapshot & snapshot) const
{
  if (mark.protocol_version < kOldestRead || mark.protocol_version > kProtocolVersion) {
    return "it is of protocol version " + std::to_string(mark.protocol_version) +
           ", and this node speaks " + std::to_string(kProtocolVersion);
  }
  const std::string fault = size_fault(mark);
  if (!fault.empty()) {
    return fault;
  }
  if (mark.parts.size() + 1 != snapshot.blocks.size()) {
    return "it has " + std::to_string(snapshot.blocks.size() - 1) +
           " parts, but its mark lists " + std::to_string(mark.parts.size());
  }
  const std::string differing = differing_part(parts_, mark);
  return differing.empty() ? "" :
         "its part on " + differing + ": it is of another version of the program";
}

// --- state_config ------------------------------------------------------------------------------

void HandoffSession::take_config(const Bytes & data)
{
  std::optional<StateConfig> config;
  try {
    const NodeIdentity & own_identity = entities.identity;
    const std::string principal =
      "instance:" + own_identity.process + "#" + std::to_string(own_identity.instance);
    if (decoded_sealed(data).principal != principal) {
      return;
    }
    const auto plain = links_.configs.open(data);
    if (plain) {
      config = decoded_config(*plain);
    }
  } catch (const Malformed &) {
    return;
  }
  if (!config) {
    refuse("it is not of this node's master, or it is repeated");
  } else {
    configured(*config);
  }
}

void HandoffSession::configured(const StateConfig & config)
{
  const NodeIdentity & identity = entities.identity;
  const bool is_source = config.source == identity.instance;
  const bool is_destination = config.destination == identity.instance;
  if (config.process != identity.process || !(is_source || is_destination)) {
    return;
  }
  const std::string fault = fault_of(config);
  if (!fault.empty()) {
    refuse(fault);
    return;
  }
  if (is_early(config)) {
    hold(config);
    return;
  }
  if (!early_.empty() && config.epoch > epoch_) {
    look_at_early();  // earlier messages of the new master come first
  }
  epoch_ = config.epoch;
  try {
    if (is_destination) {
      if (destination_) {
        destination_->configure(config);
      }
    } else if (source_) {
      source_->configure(config);
    } else {
      // A node reports ACTIVE before it is a source; the next handoff may begin in between.
      push_bounded(before_source_, config);
    }
  } catch (const std::exception & error) {  // no message of the master may end the node
    entities.middleware.log(
      Severity::kError, std::string("a state_config cannot be followed: ") + error.what());
  }
}

/// Return the reason to ignore this message; "" if it comes from this node's master.
std::string HandoffSession::fault_of(const StateConfig & config) const
{
  const NodeIdentity & identity = entities.identity;
  if (config.protocol_version != kProtocolVersion) {
    return "its protocol version is " + std::to_string(config.protocol_version) +
           ", this node's " + std::to_string(kProtocolVersion);
  }
  if (config.cluster != identity.cluster) {
    return "it is of '" + config.cluster.substr(0, kLongestName) + "', and '" +
           identity.cluster + "' started this node";
  }
  // A master with an older copy of its journal counts from there, and the slave knows it.
  if (config.epoch < epoch_ && identity.registered_epoch() != config.epoch) {
    return "it is of epoch " + std::to_string(config.epoch) + ", and this is epoch " +
           std::to_string(epoch_);
  }
  if (config.channel.empty()) {
    return "it names no channel";
  }
  const std::string prefix = identity.name_space() + "/handoff/";
  if (config.channel.compare(0, prefix.size(), prefix) != 0) {
    return "its channel is no topic of a handoff";
  }
  return "";
}

/// Return true if a message has an epoch that the slave does not know. A forged epoch would make
/// this node refuse all later messages of its master.
bool HandoffSession::is_early(const StateConfig & config) const
{
  if (config.epoch <= epoch_) {
    return false;
  }
  return config.epoch > entities.identity.registered_epoch().value_or(epoch_ + kEpochStep);
}

void HandoffSession::hold(const StateConfig & config)
{
  push_bounded(early_, {config, entities.middleware.now() + patience_.early});
  if (early_alarm_ == 0) {
    early_alarm_ = entities.alarms.start(kEarlyLook, [this] {look_at_early();});
  }
}

/// Follow held messages whose epoch the slave knows now; drop old ones.
void HandoffSession::look_at_early()
{
  for (const auto & held : std::exchange(early_, {})) {
    if (!is_early(held.config)) {
      configured(held.config);
    } else if (entities.middleware.now() < held.until) {
      early_.push_back(held);
    } else {
      refuse(
        "it is of epoch " + std::to_string(held.config.epoch) +
        ", which the slave of this host does not know");
    }
  }
  if (early_.empty()) {
    entities.alarms.stop(early_alarm_);
  }
}

void HandoffSession::refuse(const std::string & fault)
{
  if (refused_.size() < kMostReasons && refused_.insert(fault).second) {
    entities.middleware.log(Severity::kWarning, "a state_config is left alone: " + fault);
  }
}

void HandoffSession::store()
{
  if (source_) {
    source_->end();
  }
}

void HandoffSession::close()
{
  if (source_) {
    source_->close();
  }
  if (destination_) {
    destination_->close();
  }
  entities.alarms.stop(restore_alarm_);
  entities.alarms.stop(early_alarm_);
}

}  // namespace rosrm_node
