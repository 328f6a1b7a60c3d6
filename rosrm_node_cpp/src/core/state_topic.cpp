#include "rosrm_node_cpp/core/state_topic.hpp"

#include <map>
#include <utility>

namespace rosrm_node
{

StateTopic::StateTopic(std::string topic, std::string type, Save save, Restore restore)
: topic_(std::move(topic)), type_(std::move(type)), save_(std::move(save)),
  restore_(std::move(restore))
{
}

void StateTopic::show_to(std::function<void(const Bytes &)> publish)
{
  publish_ = std::move(publish);
  is_shown_ = false;
}

void StateTopic::publish()
{
  refresh();
  show();
}

void StateTopic::show()
{
  if (data_ && !is_shown_) {
    publish_(*data_);
    is_shown_ = true;
  }
}

void StateTopic::refresh()
{
  try {
    auto data = checked();
    if (data) {
      refused_.clear();
      if (data != data_) {
        data_ = std::move(data);
        key_.reset();
        is_shown_ = false;
      }
    }
  } catch (const StateError & error) {
    data_.reset();  // a later "unchanged" would refer to a state never saved
    if (refused_.empty()) {
      refused_ = error.what();
    }
    throw;
  }
}

std::optional<Bytes> StateTopic::checked()
{
  std::optional<Bytes> data;
  try {
    data = save_();
  } catch (const std::exception & error) {
    throw StateError("saving " + topic_ + " raised " + error.what());
  }
  if (!data && !data_) {
    throw StateError(
            !refused_.empty() ? refused_ : "saving " + topic_ +
            " returned none (unchanged) before it had returned any state");
  }
  if (data && data->size() > kLargestPart) {
    throw StateError(
            "the state on " + topic_ + " has " + std::to_string(data->size()) +
            " bytes, more than the " + std::to_string(kLargestPart) +
            " that may travel in one message: split it in several topics, or keep less");
  }
  return data;
}

const Bytes & StateTopic::saved() const
{
  if (!data_) {
    throw StateError("the state on " + topic_ + " was not saved");
  }
  return *data_;
}

StatePart StateTopic::described() const
{
  if (!data_) {
    return {topic_, type_, 0, ""};
  }
  if (!key_) {
    key_ = part_key(*data_);
  }
  return {topic_, type_, key_->size, key_->digest};
}

void StateTopic::restore_changed(const Bytes & data)
{
  const PartKey key = part_key(data);
  if (restored_ && *restored_ == key) {
    return;
  }
  try {
    restore_(data);
  } catch (const std::exception & error) {
    throw StateError("restoring " + topic_ + " raised " + error.what());
  }
  restored_ = key_ = key;  // the author's next `save` may return none, which refers to this state
  data_ = data;
  is_shown_ = false;
}

std::string differing_part(const StateTopics & parts, const StateMark & mark)
{
  struct Types
  {
    std::string ours = "none";
    std::string theirs = "none";
  };
  std::map<std::string, Types> types;
  for (const auto & part : parts) {
    types[part->topic()].ours = part->type();
  }
  for (const auto & part : mark.parts) {
    types[part.topic].theirs = part.type;
  }
  for (const auto & [topic, type] : types) {
    if (type.ours != type.theirs) {
      return topic + " is " + type.theirs + " at the source, and " + type.ours + " here";
    }
  }
  return "";
}

std::string size_fault(const StateMark & mark)
{
  if (mark.sequence >= kMostCycles) {
    return "the mark of the state has the impossible number " + std::to_string(mark.sequence);
  }
  for (const auto & part : mark.parts) {
    if (part.size > kLargestPart) {
      return "the state on " + part.topic + " claims to have " + std::to_string(part.size) +
             " bytes";
    }
  }
  return "";
}

}  // namespace rosrm_node
