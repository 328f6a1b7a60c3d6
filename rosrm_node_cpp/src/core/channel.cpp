#include "rosrm_node_cpp/core/channel.hpp"

#include <algorithm>
#include <utility>

#include "rosrm_node_cpp/core/cdr.hpp"

namespace rosrm_node
{

namespace
{

/// Most bytes of the text in a report: receivers drop reports with far longer ones.
constexpr std::size_t kLongestText = 1500;

/// Return a text in printable ASCII and of bounded length, because the author's may be anything.
std::string printable(std::string text)
{
  text.resize(std::min(text.size(), kLongestText));
  std::replace_if(
    text.begin(), text.end(), [](unsigned char one) {return one < 0x20 || one > 0x7e;}, '?');
  return text;
}

std::string named(const char * kind, const std::string & process, std::uint64_t number)
{
  return std::string(kind) + ":" + process + "#" + std::to_string(number);
}

}  // namespace

NodeLinks::NodeLinks(const NodeIdentity & identity)
: NodeLinks(identity, std::make_shared<Link>(identity.key, kToMaster, kFromMaster))
{
}

NodeLinks::NodeLinks(const NodeIdentity & identity, std::shared_ptr<Link> link)
: has_key(identity.key.has_value()),
  configs(
    link, named("instance", identity.process, identity.instance), identity.state_config,
    kConfigType),
  questions(
    link, named("instance", identity.process, identity.instance),
    identity.name_space() + "/handoff/stranded", kReportType)
{
}

std::shared_ptr<Link> NodeLinks::of_handoff(const StateConfig & config) const
{
  std::optional<Key> key;
  if (has_key) {
    key = key_of(config.key);
  }
  return std::make_shared<Link>(key, kToPeer, kToPeer);
}

SealedWriter::SealedWriter(Middleware & middleware, SealedTopic topic, std::size_t depth)
: middleware_(middleware), topic_(std::move(topic)),
  entity_(middleware.open_writer(topic_.name(), depth))
{
}

SealedWriter::~SealedWriter()
{
  middleware_.close(entity_);
}

void SealedWriter::publish(const Bytes & plain)
{
  middleware_.publish(entity_, topic_.seal(plain));
}

Channel::Channel(
  Middleware & middleware, Readers & readers, const NodeLinks & links, const StateConfig & config,
  std::uint64_t instance, std::uint64_t peer, std::uint64_t own_run,
  std::function<void(const HandoffReport &)> take_report)
: name(config.channel), destination(config.destination), run(own_run),
  middleware_(middleware), readers_(readers), link_(links.of_handoff(config)),
  principal_(named("handoff", config.process, config.destination)), instance_(instance),
  peer_(peer), take_report_(std::move(take_report)), reports_(topic(kReportType, name)),
  writer_(middleware, reports_, kReportDepth),
  reader_(middleware.open_reader(name, kReportDepth))
{
  readers_[reader_] = [this](const Bytes & data) {take(data);};
}

Channel::~Channel()
{
  readers_.erase(reader_);
  middleware_.close(reader_);
}

SealedTopic Channel::topic(const std::string & type, const std::string & topic_name) const
{
  return SealedTopic(link_, principal_, topic_name, type);
}

void Channel::take(const Bytes & data)
{
  const auto plain = reports_.open(data);
  if (!plain) {
    return;
  }
  HandoffReport report;
  try {
    report = decoded_report(*plain);
  } catch (const Malformed &) {
    return;  // with `security: none`, anyone may have sent the bytes
  }
  if (report.instance == peer_ && report.destination == destination &&
    report.protocol_version == kProtocolVersion)
  {
    const auto take_report = take_report_;  // the call may destroy this channel
    take_report(report);
  }
}

void Channel::report(Phase phase, std::uint64_t sequence, const std::string & text)
{
  const std::string message = printable(text);
  if (last_ && last_->phase == phase && last_->message == message) {
    return;
  }
  last_ = HandoffReport{kProtocolVersion, destination, instance_, run, phase, sequence, message};
  repeat();
}

void Channel::repeat()
{
  if (last_) {
    writer_.publish(encoded(*last_));
  }
}

}  // namespace rosrm_node
