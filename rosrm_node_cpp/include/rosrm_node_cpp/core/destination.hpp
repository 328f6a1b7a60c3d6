/// \file
/// Destination of a handoff: follows the source's state until it takes over.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "rosrm_node_cpp/core/channel.hpp"
#include "rosrm_node_cpp/core/node_entities.hpp"
#include "rosrm_node_cpp/core/snapshot_assembler.hpp"
#include "rosrm_node_cpp/core/state_topic.hpp"

namespace rosrm_node
{

/// Role of a shadow until it is active; then `activated` is called.
class Destination
{
public:
  Destination(
    NodeEntities & entities, Readers & readers, StateTopics & parts, NodeLinks & links,
    std::string mark_topic, std::function<void()> activated);
  ~Destination();

  /// Handle a message of the master about the handoff to this node.
  void configure(const StateConfig & config);

  /// Subscribe to a part of the state; the author may name parts later.
  void follow_part(const StateTopic & part);

  /// Leave the channel of a finished handoff.
  void close();

  /// Prevent the activation, in a test.
  void hold() {held_ = true;}

private:
  /// A topic of the source.
  struct Followed
  {
    int reader;
    /// Processes a message; returns false if it is forged.
    std::function<bool(const Bytes &)> take;
  };

  void open(const StateConfig & config);
  void follow(SealedTopic topic, std::size_t depth, std::function<void(const Bytes &)> take);
  void take_report(const HandoffReport & report);
  void came(const std::function<bool(const Bytes &)> & take, const Bytes & data);
  bool catch_up();
  void take_mark(const Bytes & data);
  std::string fault_of(const StateMark & mark) const;
  void look();
  void go_on();
  bool restore(Cut cut);
  bool has_lost_history();
  bool is_unsure();
  void ask_for_history();
  void review();
  bool is_last() const;
  std::uint64_t sequence() const;
  std::string still_missing();
  std::string missing_peers() const;
  std::string missing_state() const;
  std::string missing_input(const std::string & input, double now);
  void take_over_when_quiet();
  void activate_if_complete();
  void activate();
  void end(Phase phase, const std::string & message);
  void overflowed(const std::string & topic);
  void unfollow();

  NodeEntities & entities_;
  Readers & readers_;
  StateTopics & parts_;
  NodeLinks & links_;
  std::string mark_topic_;
  std::function<void()> activated_;
  std::unique_ptr<Channel> channel_;
  std::optional<CutAssembler> assembler_;
  std::vector<Followed> followed_;
  int alarm_ = 0;
  std::optional<Cut> cut_;
  std::uint64_t run_ = 0;
  bool attached_ = false;
  std::optional<std::uint64_t> silent_at_;
  bool alone_ = false;
  bool active_ = false;
  double last_report_ = 0.0;
  double asked_at_ = -1.0;
  std::optional<double> matched_at_;
  bool was_ready_ = false;
  bool may_switch_ = false;
  bool ended_ = false;
  bool held_ = false;
  std::string fault_;
};

}  // namespace rosrm_node
