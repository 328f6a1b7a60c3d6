/// \file
/// The topics of one handoff, and the links of a node with its master.
#pragma once

#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "rosrm_node_cpp/core/identity.hpp"
#include "rosrm_node_cpp/core/messages.hpp"
#include "rosrm_node_cpp/core/middleware.hpp"
#include "rosrm_node_cpp/core/sealing.hpp"

namespace rosrm_node
{

/// Messages that a publisher keeps for late subscribers, by the kind of topic.
constexpr std::size_t kConfigDepth = 200;
constexpr std::size_t kReportDepth = 20;
constexpr std::size_t kMarkDepth = 100;
constexpr std::size_t kStateDepth = 1;
/// At the destination, a newer message of one part must not replace the one of an older mark.
constexpr std::size_t kStateFollowedDepth = 10;

/// Subscriptions of the protocol, by their numbers.
using Readers = std::map<int, std::function<void(const Bytes &)>>;

/// Links of one instance with its master.
struct NodeLinks
{
  explicit NodeLinks(const NodeIdentity & identity);

  /// Return the link of the parties of a handoff.
  /// \throws std::invalid_argument the master has sent no key, although this node has one.
  std::shared_ptr<Link> of_handoff(const StateConfig & config) const;

  bool has_key;
  /// Messages of the master.
  SealedTopic configs;
  /// Reports of a silent source to the master.
  SealedTopic questions;

private:
  NodeLinks(const NodeIdentity & identity, std::shared_ptr<Link> link);
};

/// Publisher of a sealed topic.
class SealedWriter
{
public:
  SealedWriter(Middleware & middleware, SealedTopic topic, std::size_t depth);
  ~SealedWriter();
  SealedWriter(const SealedWriter &) = delete;
  SealedWriter & operator=(const SealedWriter &) = delete;

  void publish(const Bytes & plain);

private:
  Middleware & middleware_;
  SealedTopic topic_;
  int entity_;
};

/// The topics of one handoff: the reports of its nodes, and the state of the source.
class Channel
{
public:
  /// \param peer instance number of the other side.
  /// \param run random number of a source's run; 0 for a destination.
  /// \param take_report receives each report of the other side.
  Channel(
    Middleware & middleware, Readers & readers, const NodeLinks & links,
    const StateConfig & config, std::uint64_t instance, std::uint64_t peer, std::uint64_t run,
    std::function<void(const HandoffReport &)> take_report);
  ~Channel();
  Channel(const Channel &) = delete;
  Channel & operator=(const Channel &) = delete;

  const std::string name;
  const std::uint64_t destination;
  const std::uint64_t run;

  /// Return a topic under the key of the handoff.
  SealedTopic topic(const std::string & type, const std::string & name) const;

  /// Publish a report, unless it repeats the last one.
  void report(Phase phase, std::uint64_t sequence = 0, const std::string & message = "");

  /// Publish the last report again.
  void repeat();

private:
  void take(const Bytes & data);

  Middleware & middleware_;
  Readers & readers_;
  std::shared_ptr<Link> link_;
  std::string principal_;
  std::uint64_t instance_;
  std::uint64_t peer_;
  std::function<void(const HandoffReport &)> take_report_;
  std::optional<HandoffReport> last_;
  SealedTopic reports_;
  SealedWriter writer_;
  int reader_;
};

constexpr const char * kReportType = "rosrm_msgs/msg/HandoffReport";
constexpr const char * kConfigType = "rosrm_msgs/msg/StateConfig";
constexpr const char * kMarkType = "rosrm_msgs/msg/StateMark";

}  // namespace rosrm_node
