/// \file
/// Identity of this process's instance, from the environment that rosrm's slave sets.
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>

#include "rosrm_node_cpp/core/sealing.hpp"

namespace rosrm_node
{

/// Identity of a node within rosrm.
struct NodeIdentity
{
  std::string process;
  std::uint64_t instance = 0;
  /// Fully qualified name that peers use, whatever the node's alias.
  std::string node;
  /// Topic of the master's messages.
  std::string state_config;
  /// Name and epoch of the master that started the process.
  std::string cluster;
  std::uint64_t epoch = 0;
  /// The process starts as the destination of a handoff.
  bool shadow = false;
  /// Directory of its snapshots, "" if none are written, and their greatest age in seconds.
  std::string keep;
  double keep_every = 1.0;
  /// File in which the slave notes the newest epoch of the master; "": nowhere.
  std::string epoch_file;
  /// Key of the instance; none with `security: none`.
  std::optional<Key> key;

  /// Return the namespace of rosrm's topics.
  std::string name_space() const;

  /// Return the newest epoch of the master that the slave knows; none: not known.
  std::optional<std::uint64_t> registered_epoch() const;
};

/// Return the value of an environment variable, "" if it is not set.
using Environment = std::function<std::string(const char *)>;

/// Return the environment of this process.
Environment process_environment();

/// Return the identity set by a slave; none if rosrm did not start this process.
/// \throws std::invalid_argument the key of the instance is damaged.
std::optional<NodeIdentity> identity_from(const Environment & environment);

}  // namespace rosrm_node
