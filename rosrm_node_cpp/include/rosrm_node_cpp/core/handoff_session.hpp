/// \file
/// Handoff role of a migratable node, and its subscription to the master's messages.
#pragma once

#include <cstdint>
#include <deque>
#include <memory>
#include <optional>
#include <set>
#include <string>

#include "rosrm_node_cpp/core/channel.hpp"
#include "rosrm_node_cpp/core/destination.hpp"
#include "rosrm_node_cpp/core/handoff_source.hpp"
#include "rosrm_node_cpp/core/node_entities.hpp"
#include "rosrm_node_cpp/core/snapshot_files.hpp"
#include "rosrm_node_cpp/core/state_topic.hpp"

namespace rosrm_node
{

/// Waits that a test shortens, seconds.
struct Patience
{
  /// Silence of a source until it asks the master, and asks again.
  double ask_every = 10.0;
  /// Time for which a message of an epoch is held that the slave does not know yet.
  double early = 5.0;
};

/// Handoffs of one node: possibly first as a destination, later as a source.
class HandoffSession
{
public:
  HandoffSession(
    Middleware & middleware, const NodeIdentity & identity, const Patience & patience = {});
  ~HandoffSession();
  HandoffSession(const HandoffSession &) = delete;
  HandoffSession & operator=(const HandoffSession &) = delete;

  NodeEntities entities;

  /// Take the first role; called before the author's constructor continues.
  void begin();

  /// Add a part of the state.
  /// \param part its topic is fully qualified.
  /// \throws std::invalid_argument the topic was named before.
  void keep_state(std::shared_ptr<StateTopic> part);

  /// Handle a message of a subscription of the protocol.
  void received(int reader, const Bytes & data);

  /// Do the work that is due; called by the timer of `Middleware::wake_in`.
  void wake() {entities.alarms.wake();}

  /// Store the last snapshot, because the process ends.
  void store();

  /// Leave all topics, because the node is destroyed.
  void close();

  Destination * destination() {return destination_.get();}
  HandoffSource * source() {return source_.get();}

private:
  struct Early
  {
    StateConfig config;
    double until;
  };

  std::string own(const std::string & path) const;
  void become_source();
  void restore_snapshot();
  StateMark restored(const Snapshot & snapshot);
  std::string fault_of(const StateMark & mark, const Snapshot & snapshot) const;
  void take_config(const Bytes & data);
  void configured(const StateConfig & config);
  std::string fault_of(const StateConfig & config) const;
  bool is_early(const StateConfig & config) const;
  void hold(const StateConfig & config);
  void look_at_early();
  void refuse(const std::string & fault);

  Patience patience_;
  NodeLinks links_;
  Readers readers_;
  StateTopics parts_;
  std::optional<Snapshot> snapshot_;
  std::vector<std::string> damaged_;
  std::unique_ptr<HandoffSource> source_;
  std::unique_ptr<Destination> destination_;
  std::deque<StateConfig> before_source_;
  std::set<std::string> refused_;
  std::deque<Early> early_;
  std::uint64_t epoch_;
  int early_alarm_ = 0;
  int restore_alarm_ = 0;
  int reader_ = 0;
  double give_up_ = 0.0;
};

}  // namespace rosrm_node
