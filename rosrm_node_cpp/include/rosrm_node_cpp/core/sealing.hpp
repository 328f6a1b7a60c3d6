/// \file
/// Sealed messages: ChaCha20-Poly1305 under keys that BLAKE2b derives (docs/reference/keys.md).
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "rosrm_node_cpp/core/bytes.hpp"
#include "rosrm_node_cpp/core/messages.hpp"

namespace rosrm_node
{

/// Bytes of every key.
constexpr std::size_t kKeyBytes = 32;

using Key = std::array<std::uint8_t, kKeyBytes>;
/// A topic, by its name and the type of its plain messages.
using ChannelId = std::array<std::uint8_t, 16>;

/// Directions of the messages that a key seals.
constexpr const char * kToMaster = "to the master";
constexpr const char * kFromMaster = "from the master";
constexpr const char * kToPeer = "to a peer";

/// Return the channel of a topic.
ChannelId channel_of(const std::string & topic, const std::string & type);

/// Return the key in bytes.
/// \throws std::invalid_argument the bytes are not as many as those of a key.
Key key_of(const Bytes & bytes);

/// One end of the messages under one key; without a key every message is accepted.
class Link
{
public:
  /// \param key of an instance or a handoff; none with `security: none`.
  /// \param outward direction of the messages that this end seals.
  /// \param inward direction of the messages that it opens.
  Link(std::optional<Key> key, std::string outward, std::string inward);

  /// Return a message for the other side, all fields but the principal set.
  Sealed seal(const ChannelId & channel, const Bytes & plain);

  /// Return the plain message; none: it is forged, repeated or of this side.
  std::optional<Bytes> open(const ChannelId & channel, const Sealed & sealed);

private:
  struct Opener
  {
    Run run;
    ChannelId channel;
    Key key;
    std::uint64_t newest;
  };
  struct Sealer
  {
    Key key;
    std::uint64_t counter;
  };

  Key key_for(const std::string & direction, const Run & run, const ChannelId & channel) const;

  std::optional<Key> key_;
  std::string outward_;
  std::string inward_;
  Run run_;
  std::map<ChannelId, Sealer> sealers_;
  /// The least recently used one first.
  std::vector<Opener> openers_;
};

/// One topic whose messages a link seals.
class SealedTopic
{
public:
  /// \param principal text that names the key of the link.
  SealedTopic(
    std::shared_ptr<Link> link, std::string principal, const std::string & topic,
    const std::string & type);

  /// Return the bytes of a `rosrm_msgs/msg/Sealed` with a plain message.
  Bytes seal(const Bytes & plain);

  /// Return a plain message; none: the bytes are not genuine, repeated, or of this side.
  std::optional<Bytes> open(const Bytes & data);

  const std::string & name() const {return name_;}

private:
  std::shared_ptr<Link> link_;
  std::string principal_;
  std::string name_;
  ChannelId channel_;
};

}  // namespace rosrm_node
