#include "rosrm_node_cpp/core/snapshot_saver.hpp"

#include <algorithm>
#include <exception>

namespace rosrm_node
{

namespace
{

/// Share of a node's time for saving its state; `keep_every` may require a larger one.
constexpr double kShare = 0.02;

}  // namespace

SnapshotSaver::SnapshotSaver(NodeEntities & entities, StateTopics & parts, std::uint64_t run)
: entities_(entities), parts_(parts), run_(run)
{
  if (entities.sequence > 0) {  // the state came from another instance: this one has no file of it
    arm();
  }
}

void SnapshotSaver::after_cycle()
{
  const double now = entities_.middleware.now();
  if (now >= next_) {
    keep(now);
  } else {
    arm();
  }
}

void SnapshotSaver::arm()
{
  if (alarm_ == 0 && !is_over_) {
    alarm_ = entities_.alarms.start(
      std::max(entities_.identity.keep_every, 1e-3), [this] {keep_late();});
  }
}

void SnapshotSaver::keep_late()
{
  entities_.alarms.stop(alarm_);
  if (may_keep()) {
    keep(entities_.middleware.now());
  }
}

/// Return true if the state is new, and lies between two cycles of an active node.
bool SnapshotSaver::may_keep() const
{
  const bool is_new = kept_ != entities_.sequence;
  return is_new && entities_.mode == Mode::kActive && !entities_.in_cycle;
}

void SnapshotSaver::keep(double now)
{
  if (is_over_) {
    return;
  }
  const double every = entities_.identity.keep_every;
  try {
    const Snapshot newest = snapshot();
    if (!writer_) {
      writer_.emplace(entities_.identity.keep);
    }
    if (!writer_->write(newest)) {
      is_over_ = true;
      fail("its directory is a newer instance's: no snapshot is written any more");
      return;
    }
    kept_ = entities_.sequence;
    fault_.clear();
  } catch (const std::exception & error) {
    fail(error.what());
    next_ = now + every;
    arm();  // perhaps no cycle follows
    return;
  }
  next_ = now + std::min(every, (entities_.middleware.now() - now) / kShare);
}

Snapshot SnapshotSaver::snapshot()
{
  StateMark mark;
  mark.run = run_;
  mark.sequence = entities_.sequence;
  Snapshot snapshot;
  snapshot.process = entities_.identity.process;
  snapshot.instance = entities_.identity.instance;
  snapshot.sequence = entities_.sequence;
  snapshot.blocks.emplace_back();
  for (const auto & part : parts_) {
    part->refresh();
    snapshot.blocks.push_back(part->saved());
    // No digest: the file has checksums, and hashing takes time in each cycle.
    mark.parts.push_back({part->topic(), part->type(), part->saved().size(), ""});
  }
  mark.inputs = entities_.covered_inputs();
  mark.timers_due = entities_.timers_due();
  snapshot.blocks.front() = encoded(mark);
  return snapshot;
}

void SnapshotSaver::fail(const std::string & fault)
{
  if (fault != fault_) {
    entities_.middleware.log(Severity::kWarning, "no snapshot was written: " + fault);
  }
  fault_ = fault;
}

void SnapshotSaver::close()
{
  if (!is_over_ && may_keep()) {
    keep(entities_.middleware.now());
  }
  is_over_ = true;
  entities_.alarms.stop(alarm_);
}

}  // namespace rosrm_node
