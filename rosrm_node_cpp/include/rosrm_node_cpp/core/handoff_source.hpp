/// \file
/// Active node: publishes its state to followers, and falls silent on request.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "rosrm_node_cpp/core/channel.hpp"
#include "rosrm_node_cpp/core/node_entities.hpp"
#include "rosrm_node_cpp/core/snapshot_saver.hpp"
#include "rosrm_node_cpp/core/state_topic.hpp"

namespace rosrm_node
{

/// Role of the active node towards a successor.
class HandoffSource
{
public:
  HandoffSource(
    NodeEntities & entities, Readers & readers, StateTopics & parts, NodeLinks & links,
    std::string mark_topic, double ask_every);
  ~HandoffSource();

  /// Handle a message of the master about a handoff away from this node.
  void configure(const StateConfig & config);

  /// Add another part of the state that the author names.
  void add_part(StateTopic & part);

  /// Leave the channel of a finished handoff.
  void close();

  /// Store the last snapshot, because the node is destroyed.
  void end();

  SnapshotSaver * saver() {return saver_ ? &*saver_ : nullptr;}

private:
  void open(const StateConfig & config);
  void show_part(StateTopic & part);
  void after_cycle();
  bool show(bool is_whole = false, bool last = false);
  void show_history();
  void failed(const std::string & fault);
  StateMark mark(bool is_whole, bool last);
  std::vector<std::int64_t> still_due();
  void take_report(const HandoffReport & report);
  void close_services();
  void close_next_service();
  void attach();
  void switch_over();
  void finish();
  void fall_silent();
  void release();
  void call_off();
  void resume();
  void reactivate(const std::function<void()> & announce);
  void ask();
  void ask_no_more();
  void overflowed(const std::string & topic);
  void report(Phase phase, const std::string & message = "");

  NodeEntities & entities_;
  Readers & readers_;
  StateTopics & parts_;
  NodeLinks & links_;
  std::string mark_topic_;
  double ask_every_;
  std::uint64_t run_;
  std::unique_ptr<Channel> channel_;
  std::unique_ptr<SealedWriter> marks_;
  std::vector<std::unique_ptr<SealedWriter>> states_;
  std::optional<SnapshotSaver> saver_;
  bool attached_ = false;
  bool may_switch_ = false;
  bool asked_ = false;
  bool finishing_ = false;
  std::string fault_;
  std::vector<std::int64_t> timers_due_;
  double silent_since_ = 0.0;
  int cycle_alarm_ = 0;
  int release_alarm_ = 0;
  int ask_alarm_ = 0;
  int closing_alarm_ = 0;
  /// Handoff for which the source is silent.
  std::uint64_t silent_for_ = 0;
  std::unique_ptr<SealedWriter> questions_;
};

}  // namespace rosrm_node
