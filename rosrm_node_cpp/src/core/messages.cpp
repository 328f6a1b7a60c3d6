#include "rosrm_node_cpp/core/messages.hpp"

#include "rosrm_node_cpp/core/cdr.hpp"

namespace rosrm_node
{

namespace
{

/// Longest principal: a ticket, which contains two names.
constexpr std::size_t kMostLetters = 512;
/// First protocol version with BLAKE2b digests of parts, and with positions of covered messages.
constexpr std::uint16_t kPositions = 8;

}  // namespace

Bytes encoded(const StateConfig & config)
{
  CdrWriter out;
  out.number(config.protocol_version);
  out.text(config.cluster);
  out.number(config.epoch);
  out.number(static_cast<std::uint8_t>(config.phase));
  out.text(config.process);
  out.number(config.source);
  out.number(config.destination);
  out.text(config.source_node);
  out.text(config.destination_node);
  out.text(config.channel);
  out.blob(config.key);
  out.number(config.source_run);
  return out.take();
}

StateConfig decoded_config(const Bytes & data)
{
  CdrReader in(data);
  StateConfig config;
  config.protocol_version = in.number<std::uint16_t>();
  config.cluster = in.text();
  config.epoch = in.number<std::uint64_t>();
  config.phase = static_cast<Order>(in.number<std::uint8_t>());
  config.process = in.text();
  config.source = in.number<std::uint64_t>();
  config.destination = in.number<std::uint64_t>();
  config.source_node = in.text();
  config.destination_node = in.text();
  config.channel = in.text();
  config.key = in.blob();
  config.source_run = in.number<std::uint64_t>();
  return config;
}

Bytes encoded(const HandoffReport & report)
{
  CdrWriter out;
  out.number(report.protocol_version);
  out.number(report.destination);
  out.number(report.instance);
  out.number(report.run);
  out.number(static_cast<std::uint8_t>(report.phase));
  out.number(report.sequence);
  out.text(report.message);
  return out.take();
}

HandoffReport decoded_report(const Bytes & data)
{
  CdrReader in(data);
  HandoffReport report;
  report.protocol_version = in.number<std::uint16_t>();
  report.destination = in.number<std::uint64_t>();
  report.instance = in.number<std::uint64_t>();
  report.run = in.number<std::uint64_t>();
  report.phase = static_cast<Phase>(in.number<std::uint8_t>());
  report.sequence = in.number<std::uint64_t>();
  report.message = in.text();
  return report;
}

Bytes encoded(const StateMark & mark)
{
  CdrWriter out;
  const auto time = [&out](std::int64_t value) {out.number(value);};
  out.number(mark.protocol_version);
  out.number(mark.run);
  out.number(mark.sequence);
  out.boolean(mark.last);
  out.list(
    mark.parts, [&out](const StatePart & part) {
      out.text(part.topic);
      out.text(part.type);
      out.number(part.size);
      out.text(part.digest);
    });
  out.list(
    mark.inputs, [&](const CoveredInput & input) {
      out.text(input.topic);
      out.number(input.publishers);
      out.number(input.processed);
      out.list(input.covered, time);
    });
  out.list(
    mark.outputs, [&out](const MatchedOutput & output) {
      out.text(output.topic);
      out.number(output.subscriptions);
    });
  out.list(mark.timers_due, time);
  return out.take();
}

StateMark decoded_mark(const Bytes & data)
{
  CdrReader in(data);
  const auto time = [&in] {return in.number<std::int64_t>();};
  StateMark mark;
  mark.protocol_version = in.number<std::uint16_t>();
  const bool is_old = mark.protocol_version < kPositions;
  mark.run = in.number<std::uint64_t>();
  mark.sequence = in.number<std::uint64_t>();
  mark.last = in.boolean();
  mark.parts = in.list<StatePart>(
    [&in, is_old] {
      StatePart part;
      part.topic = in.text();
      part.type = in.text();
      part.size = in.number<std::uint64_t>();
      if (is_old) {
        in.number<std::uint32_t>();  // a CRC-32
      } else {
        part.digest = in.text();
      }
      return part;
    });
  mark.inputs = in.list<CoveredInput>(
    [&] {
      CoveredInput input;
      input.topic = in.text();
      input.publishers = in.number<std::uint32_t>();
      input.processed = is_old ? 0 : in.number<std::uint64_t>();
      input.covered = in.list<std::int64_t>(time);
      input.processed = is_old ? input.covered.size() : input.processed;
      return input;
    });
  mark.outputs = in.list<MatchedOutput>(
    [&in] {
      MatchedOutput output;
      output.topic = in.text();
      output.subscriptions = in.number<std::uint32_t>();
      return output;
    });
  mark.timers_due = in.list<std::int64_t>(time);
  return mark;
}

Bytes encoded(const Sealed & sealed)
{
  CdrWriter out;
  out.reserve(sealed.body.size() + sealed.principal.size() + 96);
  out.number(sealed.format);
  out.text(sealed.principal);
  out.number(sealed.generation);
  for (const auto & run : {sealed.run, sealed.receiver_run}) {
    out.number(static_cast<std::uint32_t>(run.size()));
    out.raw(run.data(), run.size());
  }
  out.number(sealed.counter);
  out.blob(sealed.body);
  return out.take();
}

Sealed decoded_sealed(const Bytes & data)
{
  CdrReader in(data);
  Sealed sealed;
  sealed.format = in.number<std::uint8_t>();
  sealed.principal = in.text();
  if (sealed.principal.size() > kMostLetters) {
    throw Malformed("its principal is too long");
  }
  sealed.generation = in.number<std::uint32_t>();
  for (Run * run : {&sealed.run, &sealed.receiver_run}) {
    if (in.number<std::uint32_t>() != kRunBytes) {
      throw Malformed("a run has another length");
    }
    in.raw(*run);
  }
  sealed.counter = in.number<std::uint64_t>();
  sealed.body = in.blob();
  return sealed;
}

}  // namespace rosrm_node
