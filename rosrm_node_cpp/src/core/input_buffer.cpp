#include "rosrm_node_cpp/core/input_buffer.hpp"

#include <algorithm>
#include <utility>

namespace rosrm_node
{

namespace
{

/// Stored covered time stamps per input, for messages that arrive after their mark.
constexpr std::size_t kRemembered = 2 * kHistory;
/// Stored orders of publishers per input.
constexpr std::size_t kMostOrders = 64;

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

/// Return the order that a received message belongs to.
std::shared_ptr<PublisherOrder> InputBuffer::Track::note_order(const Sent & sent)
{
  const auto before = std::exchange(last, sent.stamp);
  ++received;
  mixed = mixed || (before && sent.stamp < *before);
  if (sent.number == 0) {
    return std::make_shared<PublisherOrder>();
  }
  const auto found = std::find_if(
    orders.begin(), orders.end(), [&sent](const auto & one) {
      return one->last + 1 == sent.number;
    });
  if (found != orders.end()) {
    PublisherOrder & order = **found;
    order.last = sent.number;
    const bool was_broken = std::exchange(order.broken, false);
    order.after_gap = order.after_gap || was_broken;
    return *found;
  }
  auto order = std::make_shared<PublisherOrder>();
  order->last = sent.number;
  order->after_gap = !orders.empty() && sent.number > 1;
  for (const auto & one : orders) {
    one->broken = one->broken || order->after_gap;
  }
  orders.push_back(order);
  if (orders.size() > kMostOrders) {
    const auto whole = std::find_if(
      orders.begin(), orders.end(), [](const auto & one) {return !one->after_gap;});
    orders.erase(whole == orders.end() ? orders.begin() : whole);
  }
  return order;
}

/// Note the positions of the messages that a mark names.
void InputBuffer::Track::note_history(std::uint64_t newest_processed, std::size_t count)
{
  const auto before = std::exchange(processed, newest_processed);
  const std::uint64_t unnamed = processed > count ? processed - count : 0;
  if (unnamed <= known.value_or(0)) {
    known = processed;
  } else if (!known) {
    if (unnamed > before) {
      doubtful.reset();  // this mark does not follow the one before
    }
    if (!doubtful && count >= kHistory) {
      doubtful = received;
    }
  }
}

bool InputBuffer::Track::covers(std::int64_t stamp) const
{
  return covered.count(stamp) > 0 || (!mixed && newest && stamp <= *newest);
}

void InputBuffer::overran(const std::string & input)
{
  Track & one = track(input);
  one.overrun = one.received;
  one.overrun_last = one.overrun_last || is_last;
}

void InputBuffer::mix(const std::string & input)
{
  Track & one = track(input);
  one.mixed = one.unordered = true;
}

bool InputBuffer::add(
  const std::string & input, const Sent & sent, std::function<void()> serve, double now,
  std::size_t size)
{
  Track & one = track(input);
  one.arrived_at = now;
  auto order = one.note_order(sent);
  if (one.covers(sent.stamp)) {
    one.overlap = true;
    order->after_gap = false;
    return true;
  }
  if (one.held >= limit_ || size > room_) {
    return false;
  }
  ++one.held;
  room_ -= size;
  messages_.push_back(
    {input, sent.stamp, size, std::move(order), one.received, std::move(serve)});
  return true;
}

void InputBuffer::cover(
  const std::string & input, const std::vector<std::int64_t> & stamps, std::uint64_t processed,
  bool single, double now)
{
  Track & one = track(input);
  one.mixed = one.mixed || !single || !std::is_sorted(stamps.begin(), stamps.end());
  one.note_history(processed, stamps.size());
  bool any_new = false;
  for (const auto stamp : stamps) {
    if (!one.covered.insert(stamp).second) {
      continue;
    }
    any_new = true;
    one.order.push_back(stamp);
    one.newest = one.newest ? std::max(*one.newest, stamp) : stamp;
  }
  if (any_new) {
    one.arrived_at = now;
    while (one.order.size() > kRemembered) {
      one.covered.erase(one.order.front());
      one.order.pop_front();
    }
    drop_covered(input, one);
  }
  // Marks will name a message that the source has not processed yet, but no forgotten one.
  if (!one.known && one.doubtful && !holds(input, *one.doubtful)) {
    one.known = one.processed;
  }
}

/// Return true if a received message up to this number is in the buffer.
bool InputBuffer::holds(const std::string & input, std::size_t number) const
{
  return std::any_of(
    messages_.begin(), messages_.end(), [&](const auto & message) {
      return message.input == input && message.number <= number;
    });
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
      message.order->after_gap = false;
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
  return !one.mixed && one.newest && (!one.last || *one.last < *one.newest);
}

bool InputBuffer::misses_one(const std::string & input)
{
  const Track & one = track(input);
  if (one.mixed && (one.overrun_last || holds(input, one.overrun))) {
    return true;
  }
  return !one.unordered && std::any_of(
    one.orders.begin(), one.orders.end(), [](const auto & order) {return order->after_gap;});
}

Known InputBuffer::known(const std::string & input)
{
  const Track & one = track(input);
  if (!one.mixed || one.processed == 0 || one.known == one.processed) {
    return Known::kAll;
  }
  const bool is_lost = one.known && one.processed - *one.known > kHistory;
  return is_lost ? Known::kLost : Known::kGap;
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
