#include "rosrm_node_cpp/core/input_buffer.hpp"

#include <algorithm>
#include <utility>

namespace rosrm_node
{

namespace
{

/// Stored covered time stamps per input, for messages that arrive after their mark.
constexpr std::size_t kRemembered = 4096;

}  // namespace

InputBuffer::InputBuffer(std::size_t limit, std::size_t room, double now)
: limit_(limit), room_(room), since_(now)
{
}

InputBuffer::Track & InputBuffer::track(const std::string & input)
{
  const auto [found, is_new] = tracks_.try_emplace(input);
  if (is_new) {
    found->second.arrived_at = since_;
  }
  return found->second;
}

void InputBuffer::Track::note_order(const Sent & sent)
{
  const auto before = std::exchange(last, sent);
  if (!before) {
    return;
  }
  if (sent.stamp < before->stamp) {
    mixed = true;
  } else if (before->number != 0 && sent.number > before->number + 1) {
    after_gap = sent.stamp;
  }
}

bool InputBuffer::Track::covers(std::int64_t stamp) const
{
  return covered.count(stamp) > 0 || (!mixed && newest && stamp <= *newest);
}

void InputBuffer::mix(const std::string & input)
{
  track(input).mixed = true;
}

bool InputBuffer::add(
  const std::string & input, const Sent & sent, std::function<void()> serve, double now,
  std::size_t size)
{
  Track & one = track(input);
  one.arrived_at = now;
  one.note_order(sent);
  if (one.covers(sent.stamp)) {
    one.overlap = true;
    return true;
  }
  if (one.held >= limit_ || size > room_) {
    return false;
  }
  ++one.held;
  room_ -= size;
  messages_.push_back({input, sent.stamp, size, std::move(serve)});
  return true;
}

void InputBuffer::cover(
  const std::string & input, const std::vector<std::int64_t> & stamps, bool single, double now)
{
  Track & one = track(input);
  one.mixed = one.mixed || !single || !std::is_sorted(stamps.begin(), stamps.end());
  bool any_new = false;
  for (const auto stamp : stamps) {
    if (!one.covered.insert(stamp).second) {
      continue;
    }
    any_new = true;
    one.order.push_back(stamp);
    one.newest = one.newest ? std::max(*one.newest, stamp) : stamp;
  }
  if (!any_new) {
    return;
  }
  one.arrived_at = now;
  while (one.order.size() > kRemembered) {
    one.covered.erase(one.order.front());
    one.order.pop_front();
  }
  drop_covered(input, one);
}

void InputBuffer::drop_covered(const std::string & input, Track & track)
{
  if (track.held == 0) {
    return;
  }
  std::deque<BufferedMessage> left;
  for (auto & message : messages_) {
    if (message.input == input && track.covers(message.stamp)) {
      track.overlap = true;
      --track.held;
      room_ += message.size;
    } else {
      left.push_back(std::move(message));
    }
  }
  messages_ = std::move(left);
}

bool InputBuffer::overlaps(const std::string & input)
{
  return track(input).overlap;
}

bool InputBuffer::is_behind(const std::string & input)
{
  const Track & one = track(input);
  return !one.mixed && one.newest && (!one.last || one.last->stamp < *one.newest);
}

bool InputBuffer::misses_one(const std::string & input)
{
  const Track & one = track(input);
  return one.after_gap && !one.mixed && (!one.newest || *one.newest < *one.after_gap);
}

bool InputBuffer::is_idle(
  const std::string & input, double now, double since, double for_seconds)
{
  const Track & one = track(input);
  return one.held == 0 && now - std::max(one.arrived_at, since) >= for_seconds;
}

bool InputBuffer::is_marked(const std::string & input, std::int64_t stamp) const
{
  const auto found = tracks_.find(input);
  return found != tracks_.end() && found->second.covered.count(stamp) > 0;
}

std::optional<BufferedMessage> InputBuffer::take()
{
  if (messages_.empty()) {
    return std::nullopt;
  }
  BufferedMessage message = std::move(messages_.front());
  messages_.pop_front();
  --tracks_.at(message.input).held;
  room_ += message.size;
  return message;
}

}  // namespace rosrm_node
