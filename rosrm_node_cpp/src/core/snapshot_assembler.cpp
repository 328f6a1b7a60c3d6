#include "rosrm_node_cpp/core/snapshot_assembler.hpp"

#include <sodium.h>

#include <algorithm>
#include <array>
#include <stdexcept>

namespace rosrm_node
{

namespace
{

/// Bytes of a digest: two contents with the same one do not occur.
constexpr std::size_t kDigestBytes = 16;

PartKey key_in(const StatePart & part)
{
  return {part.size, part.digest};
}

std::size_t entries_of(const StateMark & mark)
{
  std::size_t entries =
    mark.parts.size() + mark.inputs.size() + mark.outputs.size() + mark.timers_due.size();
  for (const auto & input : mark.inputs) {
    entries += input.covered.size();
  }
  return entries;
}

bool names(const StateMark & mark, const std::string & topic, const PartKey & key)
{
  return std::any_of(
    mark.parts.begin(), mark.parts.end(), [&](const StatePart & part) {
      return part.topic == topic && key_in(part) == key;
    });
}

}  // namespace

PartKey part_key(const Bytes & data)
{
  std::array<unsigned char, kDigestBytes> digest;
  if (crypto_generichash_blake2b_salt_personal(
      digest.data(), digest.size(), data.data(), data.size(), nullptr, 0, nullptr, nullptr) != 0)
  {
    throw std::runtime_error("BLAKE2b failed");
  }
  constexpr char digits[] = "0123456789abcdef";
  PartKey key{data.size(), ""};
  for (const auto byte : digest) {
    key.digest += {digits[byte >> 4], digits[byte & 0xF]};
  }
  return key;
}

CutAssembler::CutAssembler(const AssemblerLimits & limits)
: limits_(limits)
{
}

void CutAssembler::expect(const std::string & topic)
{
  parts_.try_emplace(topic);
}

void CutAssembler::add_part(const std::string & topic, Bytes data)
{
  auto & stored = parts_.at(topic);
  const PartKey key = part_key(data);
  stored.remove_if([&key](const Stored & one) {return one.key == key;});
  stored.push_back({key, std::move(data)});
  std::size_t excess = stored.size() > limits_.parts ? stored.size() - limits_.parts : 0;
  for (auto old = stored.begin(); excess > 0; --excess) {
    const bool is_named = std::any_of(
      waiting_.begin(), waiting_.end(), [&](const Waiting & one) {
        return names(one.mark, topic, old->key);
      });
    old = is_named ? std::next(old) : stored.erase(old);
  }
  std::uint64_t bytes = 0;
  for (const auto & one : stored) {
    bytes += one.key.size;
  }
  while (stored.size() > 1 && bytes > limits_.bytes) {
    bytes -= stored.front().key.size;
    stored.pop_front();
  }
}

bool CutAssembler::add_mark(StateMark mark, double now)
{
  entries_ += entries_of(mark);
  waiting_.push_back({std::move(mark), now});
  return waiting_.size() <= limits_.marks && entries_ <= limits_.entries;
}

const CutAssembler::Stored * CutAssembler::found(
  const std::string & topic, const PartKey & key) const
{
  const auto stored = parts_.find(topic);
  if (stored == parts_.end()) {
    return nullptr;
  }
  for (const auto & one : stored->second) {
    if (one.key == key) {
      return &one;
    }
  }
  return nullptr;
}

bool CutAssembler::is_complete(const StateMark & mark) const
{
  return std::all_of(
    mark.parts.begin(), mark.parts.end(), [this](const StatePart & part) {
      return found(part.topic, key_in(part)) != nullptr;
    });
}

std::optional<Cut> CutAssembler::take()
{
  const auto newest = std::find_if(
    waiting_.rbegin(), waiting_.rend(), [this](const Waiting & one) {
      return is_complete(one.mark);
    });
  if (newest == waiting_.rend()) {
    return std::nullopt;
  }
  Cut cut;
  cut.mark = std::move(newest->mark);
  cut.arrived = newest->arrived;
  const auto own = std::prev(newest.base());
  for (auto older = waiting_.begin(); older != own; ++older) {
    cut.passed.push_back(std::move(older->mark));
  }
  waiting_.erase(waiting_.begin(), newest.base());
  entries_ = 0;
  for (const auto & one : waiting_) {
    entries_ += entries_of(one.mark);
  }
  forget_older(cut.mark);
  for (const auto & part : cut.mark.parts) {
    cut.parts[part.topic] = found(part.topic, key_in(part))->data;
  }
  return cut;
}

void CutAssembler::forget_older(const StateMark & mark)
{
  for (const auto & part : mark.parts) {
    auto & stored = parts_.at(part.topic);
    while (!(stored.front().key == key_in(part))) {
      stored.pop_front();  // parts come in order, so no later mark names an older one
    }
  }
}

std::vector<std::string> CutAssembler::missing() const
{
  std::vector<std::string> topics;
  if (waiting_.empty()) {
    return topics;
  }
  for (const auto & part : waiting_.back().mark.parts) {
    if (found(part.topic, key_in(part)) == nullptr) {
      topics.push_back(part.topic);
    }
  }
  return topics;
}

std::size_t CutAssembler::stored(const std::string & topic) const
{
  const auto found = parts_.find(topic);
  return found == parts_.end() ? 0 : found->second.size();
}

}  // namespace rosrm_node
