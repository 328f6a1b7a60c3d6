/// \file
/// Assembly of states from marks and parts, in any order of arrival.
#pragma once

#include <cstdint>
#include <list>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "rosrm_node_cpp/core/bytes.hpp"
#include "rosrm_node_cpp/core/messages.hpp"

namespace rosrm_node
{

/// Size and digest, which identify the content of one serialised message.
struct PartKey
{
  std::uint64_t size = 0;
  /// BLAKE2b in hexadecimal digits. (A CRC is not enough: a content that ends with its own CRC, as
  /// those of many formats do, has always the same one.)
  std::string digest;

  bool operator==(const PartKey & other) const
  {
    return size == other.size && digest == other.digest;
  }
};

/// Return the key by which a mark names a part.
PartKey part_key(const Bytes & data);

/// A complete state.
struct Cut
{
  StateMark mark;
  /// Skipped earlier marks; this state covers everything that they cover.
  std::vector<StateMark> passed;
  /// Serialised messages by topic.
  std::map<std::string, Bytes> parts;
  /// Arrival of the mark, monotonic seconds.
  double arrived = 0.0;
};

/// Bounds on what an assembler stores.
struct AssemblerLimits
{
  /// Newest parts of one topic that no mark names yet, and bytes of all its stored parts.
  std::size_t parts = 16;
  std::uint64_t bytes = std::uint64_t{1} << 30;
  /// Marks that wait for parts of their states, and entries of their lists.
  std::size_t marks = 20'000;
  std::size_t entries = 50'000'000;
};

/// Assembly of the newest state whose parts have all arrived.
class CutAssembler
{
public:
  explicit CutAssembler(const AssemblerLimits & limits = AssemblerLimits{});

  /// Add a topic that carries a part of the state.
  void expect(const std::string & topic);

  /// Add a message of a state topic.
  void add_part(const std::string & topic, Bytes data);

  /// Add a mark, newer than all before; return false if too many wait for their parts.
  bool add_mark(StateMark mark, double now);

  /// Return the newest complete state not taken before; drop older ones.
  std::optional<Cut> take();

  /// Return the topics of the newest mark whose part has not arrived.
  std::vector<std::string> missing() const;

  /// Return the number of stored parts of a topic.
  std::size_t stored(const std::string & topic) const;

private:
  struct Stored
  {
    PartKey key;
    Bytes data;
  };
  struct Waiting
  {
    StateMark mark;
    double arrived;
  };

  const Stored * found(const std::string & topic, const PartKey & key) const;
  bool is_complete(const StateMark & mark) const;
  void forget_older(const StateMark & mark);

  AssemblerLimits limits_;
  /// Parts of each topic, the oldest first.
  std::map<std::string, std::list<Stored>> parts_;
  std::vector<Waiting> waiting_;
  std::size_t entries_ = 0;
};

}  // namespace rosrm_node
