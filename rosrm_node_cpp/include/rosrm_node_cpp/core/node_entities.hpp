/// \file
/// Layer between the author's callbacks and ROS in a migratable node.
///
/// At any time the node is active (messages pass directly), a shadow (inputs are buffered, outputs
/// dropped), or silent (the same, for a source whose successor may be active). Each callback of the
/// author is one cycle, and cycles never overlap, so that a state always lies between two of them.
#pragma once

#include <atomic>
#include <cstdint>
#include <deque>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#include "rosrm_node_cpp/core/alarms.hpp"
#include "rosrm_node_cpp/core/identity.hpp"
#include "rosrm_node_cpp/core/input_buffer.hpp"
#include "rosrm_node_cpp/core/messages.hpp"
#include "rosrm_node_cpp/core/middleware.hpp"

namespace rosrm_node
{

/// State of a node in a handoff.
enum class Mode {kActive, kShadow, kSilent};

/// One subscription of the author.
struct Input
{
  /// Fully qualified name of the topic.
  std::string topic;
  /// The topic, or `/topic#2` for a second subscription of it; set by `NodeEntities`.
  std::string key;
  /// Messages are stored during a handoff.
  bool buffered = true;
  /// Every message counts, not only the newest: a reliable input with a depth above 1.
  bool wants_all = false;
  /// Maximum number of messages that the reader keeps; 0: unlimited.
  std::size_t depth = 0;
  /// Returns the number of matched publishers.
  std::function<std::uint32_t()> publishers;
  /// Gives all waiting messages to `NodeEntities::keep`.
  std::function<void()> take_waiting;
  /// Source time stamps of the newest processed messages, ns.
  std::deque<std::int64_t> covered;
  /// Position of the last one.
  std::uint64_t processed = 0;

  /// Note a processed message by its source time stamp.
  void note(std::int64_t stamp);
};

/// One publisher of the author.
struct Output
{
  std::string topic;
  /// Returns the number of matched subscriptions.
  std::function<std::uint32_t()> subscriptions;
  /// Returns true if all messages are acknowledged.
  std::function<bool()> acknowledged;
};

/// One timer of the author.
struct TimerOf
{
  /// Returns the nanoseconds until the timer is due; -1: it is cancelled.
  std::function<std::int64_t()> due;
  /// Starts the timer: first run after some nanoseconds, at most a period; then with its period.
  std::function<void(std::int64_t)> start_in;
  /// Cancels the timer.
  std::function<void()> stop;
  /// The timer follows simulated time: it starts with a new period.
  std::function<bool()> follows_ros_time = [] {return false;};
  /// The timer runs, or will run when its node becomes active.
  bool started = true;
};

/// One service of the author, or another object that may exist only while the node is active.
struct Opening
{
  /// Creates the object.
  std::function<void()> open;
  /// Destroys the object.
  std::function<void()> close;
  /// A service is closed when the successor is active, any other object when the node falls silent.
  bool is_service = false;
  /// Answers the oldest request that came during a silence; returns false if there is none.
  std::function<bool()> serve_held = [] {return false;};
  bool is_open = false;
};

/// One received message of an input.
struct Arrival
{
  Sent sent;
  /// Returns the bytes of the message; called only if the message is buffered.
  std::function<std::size_t()> size;
  /// Lets the author's callback process the message.
  std::function<void()> serve;
};

class NodeEntities
{
public:
  NodeEntities(Middleware & middleware, NodeIdentity identity, bool resting);

  Middleware & middleware;
  const NodeIdentity identity;
  Alarms alarms;
  Mode mode;
  /// Number of cycles so far.
  std::uint64_t sequence = 0;
  /// A callback of the author has begun and not ended; also true after it threw.
  bool in_cycle = false;
  /// True: messages of the author are sent. Publishers share it, and other threads may read it.
  const std::shared_ptr<std::atomic<bool>> gate;
  InputBuffer buffer;
  std::vector<std::shared_ptr<Input>> inputs;
  std::vector<std::shared_ptr<Output>> outputs;
  std::vector<std::shared_ptr<TimerOf>> timers;
  /// Called after each cycle; set by the role in a handoff, as is the next.
  std::function<void()> on_cycle = [] {};
  /// Called with the topic of an input whose buffer is full.
  std::function<void(const std::string &)> on_overflow = [](const std::string &) {};

  /// Return the name of the author without the alias under which this node may run.
  /// \param resolved fully qualified name, as resolved by the node.
  /// \param own fully qualified name of the node, with the alias.
  std::string visible(const std::string & resolved, const std::string & own) const;

  void add(std::shared_ptr<Input> input);
  void add(std::shared_ptr<Output> output) {outputs.push_back(std::move(output));}
  void add(std::shared_ptr<TimerOf> timer);
  void add(std::shared_ptr<Opening> opening);

  /// Run a callback of the author as one cycle.
  void cycle(const std::function<void()> & callback);

  /// Run a timer's callback, unless this node is not active.
  void ticked(const std::function<void()> & callback);

  /// Process a message, or buffer it while this node is not active.
  void received(Input & input, Arrival arrival);

  /// Buffer a message for the next active node: this one, or a successor.
  void keep(Input & input, Arrival arrival);

  /// Buffer received messages of all buffered inputs, because a DDS reader has less room.
  void catch_up();

  /// Return an input that has lost a message and needs every one; "" if there is none.
  std::string input_with_gap();

  /// Return an input of which the buffer has this knowledge; "" if there is none.
  std::string input_known(Known known);

  /// Return true while buffered messages may be left; new messages then queue behind them.
  bool is_replaying() const {return replay_ != 0;}

  /// Serve received messages, which a later shadow does not receive; then call `then`.
  void serve_what_has_come(std::function<void()> then);

  /// Stop publishing and all timers; return `timers_due` from before.
  std::vector<std::int64_t> fall_silent();

  /// Close one service, the newest first; return false if none is open. The successor answers, and
  /// requests to this node would be lost.
  bool close_next_service();

  /// Return the processed messages of each buffered input, for a mark of the state.
  /// \param is_whole the mark names all that this node remembers, not only the newest.
  std::vector<CoveredInput> covered_inputs(bool is_whole = false) const;

  /// Drop messages that a state covers, now or when they arrive.
  void cover(const std::vector<CoveredInput> & covered);

  /// Treat messages that the source of the state processed as processed here.
  void inherit(const std::vector<CoveredInput> & covered);

  /// Return the nanoseconds until each timer is due, in order of creation; -1: cancelled.
  std::vector<std::int64_t> timers_due() const;

  /// Become active: first announce it, then serve buffered messages.
  /// \param due as `timers_due` returned it; timers beyond the list start now.
  /// \param since monotonic time at which it did.
  /// \param announce called first, because serving may take long.
  /// \param settle called after the first slices of messages and the start of timers and services.
  void become_active(
    std::vector<std::int64_t> due, double since, const std::function<void()> & announce,
    const std::vector<std::function<void()>> & settle = {});

private:
  InputBuffer new_buffer();
  bool is_late(const Input & input, const Sent & sent);
  void take_waiting(Input & input, std::size_t taken = 0);
  void replay();
  bool serve_until(double end);
  bool serve_next();
  bool advance();
  void start_timers(const std::vector<std::int64_t> & due, double passed);
  void close(Opening & opening);

  std::vector<std::shared_ptr<Opening>> openings_;
  double late_until_ = 0.0;
  /// `timers_due` of a node that is active, but whose timers have not started yet.
  std::optional<std::vector<std::int64_t>> due_at_start_;
  /// Alarm of the replay of buffered messages.
  int replay_ = 0;
  /// Messages that are served before `then_` is called.
  std::size_t counted_ = 0;
  std::function<void()> then_;
  /// Further work of a node that has become active, one step after each slice.
  std::deque<std::function<void()>> steps_;
};

}  // namespace rosrm_node
