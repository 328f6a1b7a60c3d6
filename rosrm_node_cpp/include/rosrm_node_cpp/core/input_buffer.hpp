/// \file
/// Input buffer of a shadow or a silent source, until one of them is active.
#pragma once

#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <optional>
#include <set>
#include <string>
#include <vector>

namespace rosrm_node
{

/// Time and order of one sent message.
struct Sent
{
  /// Source time stamp, ns.
  std::int64_t stamp = 0;
  /// Position in its publisher's gapless order, from 1; 0 if unknown.
  std::uint64_t number = 0;
};

/// One message in the buffer.
struct BufferedMessage
{
  std::string input;
  std::int64_t stamp = 0;
  std::size_t size = 0;
  /// Lets the author's callback process the message.
  std::function<void()> serve;
};

/// Messages of all inputs, in order of arrival.
class InputBuffer
{
public:
  /// \param limit most messages of one input.
  /// \param room most bytes of all inputs together.
  /// \param now monotonic seconds.
  InputBuffer(std::size_t limit, std::size_t room, double now);

  /// Mark an input as unordered: its publishers' clocks cannot be compared.
  void mix(const std::string & input);

  /// Add a message, unless a state covers it already; return false if there is no room.
  bool add(
    const std::string & input, const Sent & sent, std::function<void()> serve, double now,
    std::size_t size = 0);

  /// Record that a state covers these messages; drop them now, or when they arrive.
  /// \param single the topic has one publisher: the source has skipped any message that is older
  ///   than the newest covered one.
  void cover(
    const std::string & input, const std::vector<std::int64_t> & stamps, bool single, double now);

  /// Return true if a received message is covered too; after that message none is missing.
  bool overlaps(const std::string & input);

  /// Return true if the one publisher's newest covered message has not arrived here.
  bool is_behind(const std::string & input);

  /// Return true if a sent message has not arrived, and no state covers it.
  bool misses_one(const std::string & input);

  /// Return true if the input is quiet: nothing is buffered, and for some seconds, which begin at
  /// `since` at the earliest, no message has reached this node or its source.
  bool is_idle(const std::string & input, double now, double since, double for_seconds);

  /// Return true if a mark has named exactly this message.
  bool is_marked(const std::string & input, std::int64_t stamp) const;

  /// Remove and return the oldest message; none: the buffer is empty.
  std::optional<BufferedMessage> take();

  std::size_t size() const {return messages_.size();}

private:
  struct Track
  {
    double arrived_at = 0.0;
    /// Newest covered time stamps, also in the order in which they were reported.
    std::set<std::int64_t> covered;
    std::deque<std::int64_t> order;
    std::optional<std::int64_t> newest;
    bool mixed = false;
    bool overlap = false;
    std::size_t held = 0;
    std::optional<Sent> last;
    /// Time stamp of the message after a missing one.
    std::optional<std::int64_t> after_gap;

    void note_order(const Sent & sent);
    bool covers(std::int64_t stamp) const;
  };

  Track & track(const std::string & input);
  void drop_covered(const std::string & input, Track & track);

  std::size_t limit_;
  std::size_t room_;
  double since_;
  std::deque<BufferedMessage> messages_;
  std::map<std::string, Track> tracks_;
};

}  // namespace rosrm_node
