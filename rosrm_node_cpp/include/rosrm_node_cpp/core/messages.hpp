/// \file
/// Messages of the handoff protocol as plain structures; `rosrm_msgs/msg` explains each field.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "rosrm_node_cpp/core/bytes.hpp"

namespace rosrm_node
{

/// `protocol_version` of all messages.
constexpr std::uint16_t kProtocolVersion = 8;
/// Bytes of the random number of a run.
constexpr std::size_t kRunBytes = 16;

using Run = std::array<std::uint8_t, kRunBytes>;

/// Phase that the master orders.
enum class Order : std::uint8_t
{
  kShadow = 1, kSwitch = 2, kTakeOver = 3, kAbort = 4, kResume = 5, kDone = 6
};

/// Phase that a node reports.
enum class Phase : std::uint8_t
{
  kAttached = 1, kSilent = 2, kReleased = 3, kResumed = 4,
  kShadowing = 11, kReady = 12, kSwitching = 13, kActive = 14, kAborted = 15,
  kFailed = 20
};

struct StateConfig
{
  std::uint16_t protocol_version = 0;
  std::string cluster;
  std::uint64_t epoch = 0;
  Order phase = Order::kShadow;
  std::string process;
  std::uint64_t source = 0;
  std::uint64_t destination = 0;
  std::string source_node;
  std::string destination_node;
  std::string channel;
  Bytes key;
  std::uint64_t source_run = 0;
};

struct HandoffReport
{
  std::uint16_t protocol_version = kProtocolVersion;
  std::uint64_t destination = 0;
  std::uint64_t instance = 0;
  std::uint64_t run = 0;
  Phase phase = Phase::kFailed;
  std::uint64_t sequence = 0;
  std::string message;
};

struct StatePart
{
  std::string topic;
  std::string type;
  std::uint64_t size = 0;
  std::string digest;
};

struct CoveredInput
{
  std::string topic;
  std::uint32_t publishers = 0;
  std::uint64_t processed = 0;
  std::vector<std::int64_t> covered;
};

struct MatchedOutput
{
  std::string topic;
  std::uint32_t subscriptions = 0;
};

struct StateMark
{
  std::uint16_t protocol_version = kProtocolVersion;
  std::uint64_t run = 0;
  std::uint64_t sequence = 0;
  bool last = false;
  std::vector<StatePart> parts;
  std::vector<CoveredInput> inputs;
  std::vector<MatchedOutput> outputs;
  std::vector<std::int64_t> timers_due;
};

/// An encrypted message.
struct Sealed
{
  std::uint8_t format = 1;
  std::string principal;
  std::uint32_t generation = 0;
  Run run{};
  Run receiver_run{};
  std::uint64_t counter = 0;
  Bytes body;
};

/// Return a message in CDR.
Bytes encoded(const StateConfig & config);
Bytes encoded(const HandoffReport & report);
Bytes encoded(const StateMark & mark);
Bytes encoded(const Sealed & sealed);

/// Return the message in CDR bytes; a mark also of an earlier protocol version, from a snapshot.
/// \throws Malformed the bytes are no such message.
StateConfig decoded_config(const Bytes & data);
HandoffReport decoded_report(const Bytes & data);
StateMark decoded_mark(const Bytes & data);
Sealed decoded_sealed(const Bytes & data);

}  // namespace rosrm_node
