/// \file
/// Input buffer of a shadow or a silent source, until one of them is active.
#pragma once

#include <cstdint>
#include <deque>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <vector>

namespace rosrm_node
{

/// Newest processed messages of each input that a source remembers. Its whole marks name all of
/// them, so a follower that has missed marks learns what these covered.
constexpr std::size_t kHistory = 8192;

/// Knowledge of the messages of an input that the source has processed.
enum class Known
{
  kAll,
  /// Marks are missing; the next whole mark names what they covered.
  kGap,
  /// The source does not remember all of it any more.
  kLost
};

/// Time and order of one sent message.
struct Sent
{
  /// Source time stamp, ns.
  std::int64_t stamp = 0;
  /// Position in its publisher's gapless order, from 1; 0 if unknown.
  std::uint64_t number = 0;
};

/// Received messages with consecutive numbers, so of one publisher.
struct PublisherOrder
{
  /// Number of the last one.
  std::uint64_t last = 0;
  /// A message of this publisher may be missing. A state that covers a later one covers that too,
  /// because the source receives each publisher's messages in order.
  bool after_gap = false;
  /// The next message may be of another publisher, because a message was missing since.
  bool broken = false;
};

/// One message in the buffer.
struct BufferedMessage
{
  std::string input;
  std::int64_t stamp = 0;
  std::size_t size = 0;
  /// Of its publisher.
  std::shared_ptr<PublisherOrder> order;
  /// Of the received messages of its input.
  std::size_t number = 0;
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

  /// The source may be silent, and would not process a message that is lost here.
  bool is_last = false;

  /// Note that the reader was full, and may have dropped messages for those received last. Of one
  /// publisher the next number shows a loss; of several ones perhaps too late.
  void overran(const std::string & input);

  /// Return the number of received messages.
  std::size_t received(const std::string & input) {return track(input).received;}

  /// Mark an input as unordered: its publishers' clocks cannot be compared.
  void mix(const std::string & input);

  /// Add a message, unless a state covers it already; return false if there is no room.
  bool add(
    const std::string & input, const Sent & sent, std::function<void()> serve, double now,
    std::size_t size = 0);

  /// Record that a state covers these messages; drop them now, or when they arrive.
  /// \param processed position of the last one; the others have the positions before.
  /// \param single the topic has one publisher: the source has skipped any message that is older
  ///   than the newest covered one.
  void cover(
    const std::string & input, const std::vector<std::int64_t> & stamps, std::uint64_t processed,
    bool single, double now);

  /// Return true if a received message is covered too; after that message none is missing.
  bool overlaps(const std::string & input);

  /// Return true if the one publisher's newest covered message has not arrived here.
  bool is_behind(const std::string & input);

  /// Return true if a sent message may not have arrived, and no state covers it.
  bool misses_one(const std::string & input);

  /// Return the knowledge of the messages that the source has processed. With one publisher the
  /// newest one is enough, as all before it were processed or skipped.
  Known known(const std::string & input);

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
    /// Time stamps may decrease: several publishers, or one restarted with its clock behind.
    bool mixed = false;
    /// Several threads take the messages, so that numbers show no loss.
    bool unordered = false;
    bool overlap = false;
    std::size_t held = 0;
    /// Messages received so far.
    std::size_t received = 0;
    /// Time stamp of the last one.
    std::optional<std::int64_t> last;
    std::deque<std::shared_ptr<PublisherOrder>> orders;
    /// Position of the newest message that a mark has named.
    std::uint64_t processed = 0;
    /// Position up to which marks have named all processed messages that came or may come here;
    /// none: the source may have forgotten one of them.
    std::optional<std::uint64_t> known;
    /// Number of the last received message that the source may have processed and forgotten: what
    /// came before the first whole mark.
    std::optional<std::size_t> doubtful;
    /// Number of the last received message when the reader was full; 0: it never was.
    std::size_t overrun = 0;
    /// The reader was full during the switch.
    bool overrun_last = false;

    std::shared_ptr<PublisherOrder> note_order(const Sent & sent);
    void note_history(std::uint64_t processed, std::size_t count);
    bool covers(std::int64_t stamp) const;
  };

  Track & track(const std::string & input);
  void drop_covered(const std::string & input, Track & track);
  bool holds(const std::string & input, std::size_t number) const;

  std::size_t limit_;
  std::size_t room_;
  double since_;
  std::deque<BufferedMessage> messages_;
  std::map<std::string, Track> tracks_;
};

}  // namespace rosrm_node
