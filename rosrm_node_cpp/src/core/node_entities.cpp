#include "rosrm_node_cpp/core/node_entities.hpp"

#include <algorithm>
#include <exception>
#include <utility>

namespace rosrm_node
{

namespace
{

/// Source time stamps in a mark that is not whole: those of the newest messages of each input.
constexpr std::size_t kNewest = 256;
/// Most messages of one input, and most bytes of all inputs, that are buffered.
constexpr std::size_t kBufferLimit = 100'000;
constexpr std::size_t kBufferBytes = std::size_t{512} << 20;
/// Seconds after activation in which a message may arrive that the source has processed.
constexpr double kLate = 10.0;
/// Seconds of one slice of the replay; a callback that has begun is finished.
constexpr double kSlice = 0.02;

}  // namespace

void Input::note(std::int64_t stamp)
{
  ++processed;
  covered.push_back(stamp);
  if (covered.size() > kHistory) {
    covered.pop_front();
  }
}

NodeEntities::NodeEntities(Middleware & ros, NodeIdentity own, bool resting)
: middleware(ros), identity(std::move(own)), alarms(ros),
  mode(resting ? Mode::kShadow : Mode::kActive),
  gate(std::make_shared<std::atomic<bool>>(!resting)), buffer(new_buffer())
{
}

InputBuffer NodeEntities::new_buffer()
{
  return InputBuffer(kBufferLimit, kBufferBytes, middleware.now());
}

std::string NodeEntities::visible(const std::string & resolved, const std::string & own) const
{
  const std::string alias = own + "/";
  if (identity.node.empty() || resolved.compare(0, alias.size(), alias) != 0) {
    return resolved;
  }
  return identity.node + "/" + resolved.substr(alias.size());
}

void NodeEntities::add(std::shared_ptr<Input> input)
{
  const auto taken = [this](const std::string & key) {
      return std::any_of(
        inputs.begin(), inputs.end(), [&key](const auto & one) {return one->key == key;});
    };
  input->key = input->topic;
  for (int number = 2; taken(input->key); ++number) {
    input->key = input->topic + "#" + std::to_string(number);
  }
  inputs.push_back(std::move(input));
}

void NodeEntities::add(std::shared_ptr<TimerOf> timer)
{
  if (mode != Mode::kActive) {
    timer->stop();
  }
  timers.push_back(std::move(timer));
}

void NodeEntities::add(std::shared_ptr<Opening> opening)
{
  if (mode == Mode::kActive) {
    opening->is_open = true;
    opening->open();
  }
  openings_.push_back(std::move(opening));
}

// --- cycles ------------------------------------------------------------------------------------

void NodeEntities::cycle(const std::function<void()> & callback)
{
  in_cycle = true;
  callback();
  in_cycle = false;
  ++sequence;
  try {
    on_cycle();
  } catch (const std::exception &) {
    if (!middleware.is_shut_down()) {  // a signal may shut ROS down while a callback runs
      throw;
    }
  }
}

void NodeEntities::ticked(const std::function<void()> & callback)
{
  if (mode == Mode::kActive) {
    cycle(callback);
  }
}

void NodeEntities::received(Input & input, Arrival arrival)
{
  if (input.buffered && (mode != Mode::kActive || is_replaying())) {
    keep(input, std::move(arrival));
    const bool is_busy = mode == Mode::kActive && middleware.now() >= late_until_;
    if (!is_busy) {
      take_waiting(input, 1);
    }
  } else if (mode == Mode::kActive && !is_late(input, arrival.sent)) {
    cycle(
      [&] {
        arrival.serve();
        input.note(arrival.sent.stamp);
      });
  }
}

bool NodeEntities::is_late(const Input & input, const Sent & sent)
{
  if (late_until_ == 0.0) {
    return false;
  }
  if (middleware.now() >= late_until_) {
    late_until_ = 0.0;
    return false;
  }
  return buffer.is_marked(input.key, sent.stamp);
}

// --- buffering ---------------------------------------------------------------------------------

void NodeEntities::keep(Input & input, Arrival arrival)
{
  const Sent sent = arrival.sent;
  auto serve = [&input, stamp = sent.stamp, call = std::move(arrival.serve)] {
      call();
      input.note(stamp);
    };
  if (!buffer.add(input.key, sent, std::move(serve), middleware.now(), arrival.size())) {
    on_overflow(input.topic);
  }
}

void NodeEntities::catch_up()
{
  for (const auto & input : inputs) {
    if (input->buffered) {
      take_waiting(*input);
    }
  }
}

void NodeEntities::take_waiting(Input & input, std::size_t taken)
{
  const std::size_t before = buffer.received(input.key);
  input.take_waiting();
  taken += buffer.received(input.key) - before;
  if (input.depth > 0 && taken >= input.depth) {
    buffer.overran(input.key);
  }
}

std::string NodeEntities::input_with_gap()
{
  for (const auto & input : inputs) {
    if (input->buffered && input->wants_all && buffer.misses_one(input->key)) {
      return input->topic;
    }
  }
  return "";
}

std::string NodeEntities::input_known(Known known)
{
  for (const auto & input : inputs) {
    if (input->buffered && buffer.known(input->key) == known) {
      return input->topic;
    }
  }
  return "";
}

void NodeEntities::serve_what_has_come(std::function<void()> then)
{
  if (!is_replaying()) {
    catch_up();
  }
  if (buffer.size() == 0) {
    then();
    return;
  }
  counted_ = buffer.size();
  then_ = std::move(then);
  if (!is_replaying()) {
    replay_ = alarms.start(0.0, [this] {replay();});
  }
}

void NodeEntities::replay()
{
  std::exception_ptr fault;
  bool more = true;
  try {
    more = serve_until(middleware.now() + kSlice);
  } catch (...) {
    fault = std::current_exception();  // of the author: passed on after the other work
  }
  const bool steps = advance();
  if ((!more || counted_ == 0) && then_) {
    std::exchange(then_, nullptr)();
  }
  if (!more && !steps) {
    alarms.stop(replay_);
  }
  if (fault) {
    std::rethrow_exception(fault);
  }
}

/// Serve messages until a time; return true if more may be left.
bool NodeEntities::serve_until(double end)
{
  while (serve_next()) {
    const bool is_last = counted_ > 0 && --counted_ == 0;
    if (is_last || middleware.now() >= end) {
      return true;
    }
  }
  return false;
}

bool NodeEntities::serve_next()
{
  if (mode != Mode::kActive) {
    return false;
  }
  if (middleware.now() < late_until_) {
    catch_up();  // afterwards only the reader's depth bounds a busy node's backlog
  }
  if (const auto message = buffer.take()) {
    cycle(message->serve);
    return true;
  }
  for (const auto & opening : openings_) {
    if (opening->serve_held()) {
      return true;
    }
  }
  return false;
}

/// Do the next step; return false if there is none.
bool NodeEntities::advance()
{
  if (steps_.empty()) {
    return false;
  }
  if (mode != Mode::kActive) {
    steps_.clear();
    return false;
  }
  const auto step = std::move(steps_.front());
  steps_.pop_front();
  step();
  return true;
}

// --- changes of the mode -----------------------------------------------------------------------

std::vector<std::int64_t> NodeEntities::fall_silent()
{
  const auto due = timers_due();
  mode = Mode::kSilent;
  *gate = false;
  if (buffer.size() == 0) {  // messages that came during the last cycle stay for the successor
    buffer = new_buffer();
  }
  for (const auto & timer : timers) {
    if (!due_at_start_) {
      timer->started = timer->due() >= 0;
    }
    timer->stop();
  }
  due_at_start_.reset();
  for (const auto & opening : openings_) {
    if (!opening->is_service) {
      close(*opening);
    }
  }
  return due;
}

bool NodeEntities::close_next_service()
{
  const auto next = std::find_if(
    openings_.rbegin(), openings_.rend(), [](const auto & opening) {
      return opening->is_service && opening->is_open;
    });
  if (next == openings_.rend()) {
    return false;
  }
  close(**next);
  return true;
}

void NodeEntities::close(Opening & opening)
{
  if (!opening.is_open) {
    return;
  }
  opening.is_open = false;
  try {
    opening.close();
  } catch (const std::exception & error) {
    middleware.log(
      Severity::kError, std::string("falling silent, and closing raised ") + error.what());
  }
}

std::vector<CoveredInput> NodeEntities::covered_inputs(bool is_whole) const
{
  std::vector<CoveredInput> covered;
  for (const auto & input : inputs) {
    if (input->buffered) {
      const auto & stamps = input->covered;
      const std::size_t count = is_whole ? stamps.size() : std::min(kNewest, stamps.size());
      const auto first = stamps.end() - static_cast<std::ptrdiff_t>(count);
      covered.push_back(
        {input->key, input->publishers(), input->processed, {first, stamps.end()}});
    }
  }
  return covered;
}

void NodeEntities::cover(const std::vector<CoveredInput> & covered)
{
  for (const auto & one : covered) {
    buffer.cover(
      one.topic, one.covered, one.processed, one.publishers <= 1, middleware.now());
  }
}

void NodeEntities::inherit(const std::vector<CoveredInput> & covered)
{
  for (const auto & one : covered) {
    for (const auto & input : inputs) {
      if (input->key == one.topic) {
        for (const auto stamp : one.covered) {
          input->note(stamp);
        }
      }
    }
  }
}

std::vector<std::int64_t> NodeEntities::timers_due() const
{
  if (due_at_start_) {
    return *due_at_start_;
  }
  std::vector<std::int64_t> due;
  for (const auto & timer : timers) {
    due.push_back(timer->due());
  }
  return due;
}

void NodeEntities::become_active(
  std::vector<std::int64_t> due, double since, const std::function<void()> & announce,
  const std::vector<std::function<void()>> & settle)
{
  mode = Mode::kActive;
  *gate = true;
  late_until_ = middleware.now() + kLate;
  due_at_start_ = due;
  announce();
  steps_.clear();
  steps_.push_back(
    [this, due = std::move(due), since] {
      start_timers(due, middleware.now() - since);
      due_at_start_.reset();
    });
  for (const auto & opening : openings_) {
    steps_.push_back(
      [opening] {
        if (!opening->is_open) {
          opening->is_open = true;
          opening->open();
        }
      });
  }
  steps_.insert(steps_.end(), settle.begin(), settle.end());
  if (!is_replaying()) {
    replay_ = alarms.start(0.0, [this] {replay();});
  }
}

void NodeEntities::start_timers(const std::vector<std::int64_t> & due, double passed)
{
  for (std::size_t index = 0; index < timers.size(); ++index) {
    TimerOf & timer = *timers[index];
    if (index >= due.size() || timer.follows_ros_time()) {
      const bool is_started = index < due.size() ? due[index] >= 0 : timer.started;
      if (is_started) {
        timer.start_in(INT64_MAX);  // a whole period
      }
    } else if (due[index] < 0) {
      timer.stop();
    } else {
      const auto left = due[index] - static_cast<std::int64_t>(passed * 1e9);
      timer.start_in(std::max<std::int64_t>(left, 1));
    }
  }
}

}  // namespace rosrm_node
