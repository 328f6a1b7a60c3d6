/// \file
/// Parts of a node's state: saved and published by the source, restored by the destination.
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include "rosrm_node_cpp/core/bytes.hpp"
#include "rosrm_node_cpp/core/messages.hpp"
#include "rosrm_node_cpp/core/snapshot_assembler.hpp"

namespace rosrm_node
{

/// Most bytes of one part.
constexpr std::uint64_t kLargestPart = std::uint64_t{256} << 20;
/// Numbers of instances and cycles are smaller; greater ones would overflow when they grow.
constexpr std::uint64_t kMostCycles = std::uint64_t{1} << 62;

/// A state cannot be saved or restored; the text names the state and the reason.
class StateError : public std::runtime_error
{
public:
  using std::runtime_error::runtime_error;
};

/// One topic of a node's state.
class StateTopic
{
public:
  /// Returns the state as a serialised message; none: unchanged since the last time.
  using Save = std::function<std::optional<Bytes>()>;
  /// Overwrites the node's state with a serialised message.
  using Restore = std::function<void (const Bytes &)>;

  StateTopic(std::string topic, std::string type, Save save, Restore restore);

  const std::string & topic() const {return topic_;}
  const std::string & type() const {return type_;}

  /// Use a function from now on; the next call publishes the part for the new successor.
  void show_to(std::function<void(const Bytes &)> publish);

  /// Save the part and publish it, if it has changed; throws the errors of `refresh`.
  void publish();

  /// Publish the saved part, if its successor does not have it.
  void show();

  /// Save the part, if it has changed.
  /// \throws StateError the part cannot be saved, or is too large.
  void refresh();

  /// Return the saved message.
  const Bytes & saved() const;

  /// Return the part's entry in a mark; the part must have been saved.
  StatePart described() const;

  /// Restore a message, unless it equals the last restored one.
  /// \throws StateError the author's function threw.
  void restore_changed(const Bytes & data);

private:
  std::optional<Bytes> checked();

  std::string topic_;
  std::string type_;
  Save save_;
  Restore restore_;
  std::function<void(const Bytes &)> publish_ = [](const Bytes &) {};
  /// The saved message.
  std::optional<Bytes> data_;
  bool is_shown_ = false;
  /// Of the saved message, once it was computed.
  mutable std::optional<PartKey> key_;
  std::optional<PartKey> restored_;
  std::string refused_;
};

using StateTopics = std::vector<std::shared_ptr<StateTopic>>;

/// Return the first difference of the parts of this node and of a mark, as "TOPIC is TYPE at the
/// source, and TYPE here"; "": all are the same.
std::string differing_part(const StateTopics & parts, const StateMark & mark);

/// Return a reason to refuse a mark for a number in it; "": there is none.
std::string size_fault(const StateMark & mark);

}  // namespace rosrm_node
