/// \file
/// Periodic saving of an active node's state, for the next start of its process.
#pragma once

#include <cstdint>
#include <optional>
#include <string>

#include "rosrm_node_cpp/core/node_entities.hpp"
#include "rosrm_node_cpp/core/snapshot_files.hpp"
#include "rosrm_node_cpp/core/state_topic.hpp"

namespace rosrm_node
{

/// Saves between cycles, as often as a share of 2 % of the node's time allows, at least once in
/// `keep_every` seconds if there was a cycle.
class SnapshotSaver
{
public:
  /// \param run random number of this run of the node.
  SnapshotSaver(NodeEntities & entities, StateTopics & parts, std::uint64_t run);

  /// Save the state after a cycle, or schedule a later save.
  void after_cycle();

  /// Store the last state at an orderly end.
  void close();

private:
  void arm();
  void keep_late();
  bool may_keep() const;
  void keep(double now);
  Snapshot snapshot();
  void fail(const std::string & fault);

  NodeEntities & entities_;
  StateTopics & parts_;
  std::uint64_t run_;
  std::optional<SnapshotWriter> writer_;
  double next_ = 0.0;
  /// Without a cycle there is nothing to keep: the author's constructor may still run.
  std::uint64_t kept_ = 0;
  int alarm_ = 0;
  /// Closed, or a newer instance writes in the directory.
  bool is_over_ = false;
  std::string fault_;
};

}  // namespace rosrm_node
