// C interface of the core of rosrm_node_cpp, for tests that are written in Python. Each function
// that returns `int` returns 0, or -1 after an exception, whose text `bridge_error` returns.

#include <cstdint>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "rosrm_node_cpp/core/cdr.hpp"
#include "rosrm_node_cpp/core/handoff_session.hpp"
#include "rosrm_node_cpp/core/input_buffer.hpp"
#include "rosrm_node_cpp/core/snapshot_assembler.hpp"
#include "rosrm_node_cpp/core/snapshot_files.hpp"

using namespace rosrm_node;  // NOLINT

namespace
{

/// Functions of the test. Bytes and texts that they return are given by `bridge_give` before.
struct Calls
{
  double (* now)();
  void (* wake_in)(double seconds);
  void (* log)(int severity, const char * text);
  int (* open_writer)(const char * topic, int depth);
  int (* open_reader)(const char * topic, int depth);
  void (* close)(int entity);
  void (* publish)(int writer, const std::uint8_t * data, std::size_t size);
  int (* take)(int reader);
  int (* matched)(int is_output, int number);
  int (* acknowledged)(int output);
  std::int64_t (* due)(int timer);
  int (* follows_ros_time)(int timer);
  void (* start_in)(int timer, std::int64_t ns);
  void (* stop)(int timer);
  int (* open)(int opening);
  int (* close_opening)(int opening);
  int (* serve_held)(int opening);
  void (* take_waiting)(int input);
  std::int64_t (* size_of)(std::int64_t ticket);
  int (* serve)(std::int64_t ticket);
  void (* drop)(std::int64_t ticket);
  int (* save)(int part);
  int (* restore)(int part, const std::uint8_t * data, std::size_t size);
};

thread_local std::string last_error;
thread_local Bytes given;

std::string given_text() {return std::string(given.begin(), given.end());}

/// Throw what the test has given, unless its function succeeded.
void check(int result)
{
  if (result < 0) {
    throw std::runtime_error(given_text());
  }
}

template<typename Call>
int guarded(Call call)
{
  try {
    return call();
  } catch (const std::exception & error) {
    last_error = error.what();
    return -1;
  }
}

class TestMiddleware : public Middleware
{
public:
  explicit TestMiddleware(const Calls & calls)
  : calls_(calls) {}

  double now() override {return calls_.now();}
  void wake_in(double seconds) override {calls_.wake_in(seconds);}
  void log(Severity severity, const std::string & text) override
  {
    calls_.log(static_cast<int>(severity), text.c_str());
  }
  int open_writer(const std::string & topic, std::size_t depth) override
  {
    const int number = calls_.open_writer(topic.c_str(), static_cast<int>(depth));
    check(number);
    return number;
  }
  int open_reader(const std::string & topic, std::size_t depth) override
  {
    const int number = calls_.open_reader(topic.c_str(), static_cast<int>(depth));
    check(number);
    return number;
  }
  void close(int entity) override {calls_.close(entity);}
  void publish(int writer, const Bytes & message) override
  {
    calls_.publish(writer, message.data(), message.size());
  }
  std::optional<Bytes> take(int reader) override
  {
    return calls_.take(reader) ? std::optional<Bytes>(std::move(given)) : std::nullopt;
  }

private:
  const Calls & calls_;
};

struct TestNode
{
  explicit TestNode(const Calls & functions)
  : calls(functions), middleware(calls) {}

  Arrival arrival(std::int64_t stamp, std::uint64_t number, std::int64_t ticket)
  {
    const std::shared_ptr<void> owner(nullptr, [this, ticket](void *) {calls.drop(ticket);});
    return {
      {stamp, number},
      [this, ticket] {return static_cast<std::size_t>(calls.size_of(ticket));},
      [this, ticket, owner] {check(calls.serve(ticket));}};
  }

  Calls calls;
  TestMiddleware middleware;
  std::unique_ptr<HandoffSession> session;
};

Bytes bytes_of(const std::uint8_t * data, std::size_t size) {return Bytes(data, data + size);}

}  // namespace

extern "C" {

const char * bridge_error() {return last_error.c_str();}

void bridge_give(const std::uint8_t * data, std::size_t size) {given = bytes_of(data, size);}

// --- a node ------------------------------------------------------------------------------------

/// Return a node; null: no slave has started it, or (with an error) its environment is damaged.
void * node_new(
  const char * const * environment, const Calls * calls, double ask_every, double early)
{
  last_error.clear();
  const Environment variables = [environment](const char * name) {
      const std::string prefix = std::string(name) + "=";
      for (auto entry = environment; *entry != nullptr; ++entry) {
        if (std::strncmp(*entry, prefix.c_str(), prefix.size()) == 0) {
          return std::string(*entry + prefix.size());
        }
      }
      return std::string();
    };
  try {
    const auto identity = identity_from(variables);
    if (!identity) {
      return nullptr;
    }
    auto node = std::make_unique<TestNode>(*calls);
    node->session = std::make_unique<HandoffSession>(
      node->middleware, *identity, Patience{ask_every, early});
    return node.release();
  } catch (const std::exception & error) {
    last_error = error.what();
    return nullptr;
  }
}

void node_free(TestNode * node) {delete node;}

int node_begin(TestNode * node)
{
  return guarded([&] {node->session->begin(); return 0;});
}

int node_close(TestNode * node)
{
  return guarded([&] {node->session->store(); node->session->close(); return 0;});
}

int node_wake(TestNode * node)
{
  return guarded([&] {node->session->wake(); return 0;});
}

int node_received(TestNode * node, int reader, const std::uint8_t * data, std::size_t size)
{
  return guarded([&] {node->session->received(reader, bytes_of(data, size)); return 0;});
}

int node_keep_state(TestNode * node, const char * topic, const char * type, int part)
{
  return guarded(
    [&] {
      node->session->keep_state(
        std::make_shared<StateTopic>(
          topic, type,
          [node, part]() -> std::optional<Bytes> {
            const int result = node->calls.save(part);
            check(result);
            return result == 0 ? std::nullopt : std::optional<Bytes>(std::move(given));
          },
          [node, part](const Bytes & data) {
            check(node->calls.restore(part, data.data(), data.size()));
          }));
      return 0;
    });
}

int node_add_input(
  TestNode * node, const char * topic, int number, int buffered, int wants_all, int depth)
{
  auto input = std::make_shared<Input>();
  input->topic = topic;
  input->buffered = buffered != 0;
  input->wants_all = wants_all != 0;
  input->depth = static_cast<std::size_t>(depth);
  input->publishers = [node, number] {
      return static_cast<std::uint32_t>(node->calls.matched(0, number));
    };
  input->take_waiting = [node, number] {node->calls.take_waiting(number);};
  return guarded([&] {node->session->entities.add(input); return 0;});
}

int node_add_output(TestNode * node, const char * topic, int number)
{
  auto output = std::make_shared<Output>();
  output->topic = topic;
  output->subscriptions = [node, number] {
      return static_cast<std::uint32_t>(node->calls.matched(1, number));
    };
  output->acknowledged = [node, number] {return node->calls.acknowledged(number) != 0;};
  return guarded([&] {node->session->entities.add(output); return 0;});
}

int node_add_timer(TestNode * node, int number)
{
  auto timer = std::make_shared<TimerOf>();
  timer->due = [node, number] {return node->calls.due(number);};
  timer->start_in = [node, number](std::int64_t ns) {node->calls.start_in(number, ns);};
  timer->stop = [node, number] {node->calls.stop(number);};
  timer->follows_ros_time = [node, number] {return node->calls.follows_ros_time(number) != 0;};
  return guarded([&] {node->session->entities.add(timer); return 0;});
}

int node_add_opening(TestNode * node, int number, int is_service)
{
  auto opening = std::make_shared<Opening>();
  opening->open = [node, number] {check(node->calls.open(number));};
  opening->close = [node, number] {check(node->calls.close_opening(number));};
  opening->serve_held = [node, number] {
      const int result = node->calls.serve_held(number);
      check(result);
      return result != 0;
    };
  opening->is_service = is_service != 0;
  return guarded([&] {node->session->entities.add(opening); return 0;});
}

/// Return 0 for an active node, 1 for a shadow, 2 for a silent node.
int node_mode(TestNode * node) {return static_cast<int>(node->session->entities.mode);}

std::uint64_t node_sequence(TestNode * node) {return node->session->entities.sequence;}

std::size_t node_buffered(TestNode * node) {return node->session->entities.buffer.size();}

/// Run a callback of the author, `serve(ticket)`, as one cycle.
int node_cycle(TestNode * node, std::int64_t ticket)
{
  return guarded(
    [&] {
      node->session->entities.cycle([&] {check(node->calls.serve(ticket));});
      return 0;
    });
}

int node_input(
  TestNode * node, int input, std::int64_t stamp, std::uint64_t number, std::int64_t ticket)
{
  return guarded(
    [&] {
      auto & entities = node->session->entities;
      entities.received(*entities.inputs.at(input), node->arrival(stamp, number, ticket));
      return 0;
    });
}

int node_keep(
  TestNode * node, int input, std::int64_t stamp, std::uint64_t number, std::int64_t ticket)
{
  return guarded(
    [&] {
      auto & entities = node->session->entities;
      entities.keep(*entities.inputs.at(input), node->arrival(stamp, number, ticket));
      return 0;
    });
}

/// Keep a destination from its activation.
void node_hold(TestNode * node)
{
  if (node->session->destination() != nullptr) {
    node->session->destination()->hold();
  }
}

// --- parts of the core -------------------------------------------------------------------------

/// Write a message again that is given in CDR; return its size, -1: it is malformed.
int message_round_trip(int kind, const std::uint8_t * data, int size, std::uint8_t * into)
{
  return guarded(
    [&] {
      const Bytes in = bytes_of(data, static_cast<std::size_t>(size));
      const Bytes out = kind == 0 ? encoded(decoded_config(in)) :
      kind == 1 ? encoded(decoded_report(in)) :
      kind == 2 ? encoded(decoded_mark(in)) : encoded(decoded_sealed(in));
      std::memcpy(into, out.data(), out.size());
      return static_cast<int>(out.size());
    });
}

InputBuffer * buffer_new(std::size_t limit, std::size_t room, double now)
{
  return new InputBuffer(limit, room, now);
}

void buffer_free(InputBuffer * buffer) {delete buffer;}

void buffer_mix(InputBuffer * buffer, const char * input) {buffer->mix(input);}

int buffer_add(
  InputBuffer * buffer, const char * input, std::int64_t stamp, std::uint64_t number, double now,
  std::size_t size)
{
  return buffer->add(input, {stamp, number}, [] {}, now, size);
}

void buffer_cover(
  InputBuffer * buffer, const char * input, const std::int64_t * stamps, std::size_t count,
  std::uint64_t processed, int single, double now)
{
  const std::vector<std::int64_t> covered(stamps, stamps + count);
  buffer->cover(input, covered, processed, single != 0, now);
}

int buffer_known(InputBuffer * buffer, const char * input)
{
  return static_cast<int>(buffer->known(input));
}

int buffer_overlaps(InputBuffer * buffer, const char * input) {return buffer->overlaps(input);}

int buffer_is_behind(InputBuffer * buffer, const char * input) {return buffer->is_behind(input);}

void buffer_overran(InputBuffer * buffer, const char * input) {buffer->overran(input);}

void buffer_set_last(InputBuffer * buffer) {buffer->is_last = true;}

int buffer_misses_one(InputBuffer * buffer, const char * input)
{
  return buffer->misses_one(input);
}

int buffer_is_idle(
  InputBuffer * buffer, const char * input, double now, double since, double for_seconds)
{
  return buffer->is_idle(input, now, since, for_seconds);
}

int buffer_is_marked(InputBuffer * buffer, const char * input, std::int64_t stamp)
{
  return buffer->is_marked(input, stamp);
}

/// Give the input and the stamp of the oldest message; return 0: the buffer is empty.
int buffer_take(InputBuffer * buffer, char * input, std::size_t room, std::int64_t * stamp)
{
  const auto message = buffer->take();
  if (!message || message->input.size() >= room) {
    return 0;
  }
  std::strcpy(input, message->input.c_str());
  *stamp = message->stamp;
  return 1;
}

CutAssembler * cuts_new(std::uint64_t bytes, std::size_t marks, std::size_t entries)
{
  AssemblerLimits limits;
  limits.bytes = bytes;
  limits.marks = marks;
  limits.entries = entries;
  return new CutAssembler(limits);
}

void cuts_free(CutAssembler * cuts) {delete cuts;}

void cuts_expect(CutAssembler * cuts, const char * topic) {cuts->expect(topic);}

void cuts_add_part(
  CutAssembler * cuts, const char * topic, const std::uint8_t * data, std::size_t size)
{
  cuts->add_part(topic, bytes_of(data, size));
}

/// Add a mark that is given in CDR.
int cuts_add_mark(CutAssembler * cuts, const std::uint8_t * data, std::size_t size, double now)
{
  return guarded([&] {return cuts->add_mark(decoded_mark(bytes_of(data, size)), now) ? 1 : 0;});
}

/// Return the newest complete state as "ARRIVED SEQUENCE TOPIC=PART …"; "": there is none.
const char * cuts_take(CutAssembler * cuts)
{
  thread_local std::string text;
  text.clear();
  if (const auto cut = cuts->take()) {
    text = std::to_string(cut->arrived) + " " + std::to_string(cut->mark.sequence);
    for (const auto & [topic, data] : cut->parts) {
      text += " " + topic + "=" + std::string(data.begin(), data.end());
    }
  }
  return text.c_str();
}

const char * cuts_missing(CutAssembler * cuts)
{
  thread_local std::string text;
  text.clear();
  for (const auto & topic : cuts->missing()) {
    text += topic + " ";
  }
  return text.c_str();
}

std::size_t cuts_stored(CutAssembler * cuts, const char * topic) {return cuts->stored(topic);}

/// Return "INSTANCE SEQUENCE BLOCKS FAULTS" of the newest snapshot in a directory.
const char * snapshot_newest(const char * directory, std::uint64_t up_to)
{
  thread_local std::string text;
  const auto found = newest_snapshot(directory, up_to);
  text = "none";
  if (found.snapshot) {
    text = std::to_string(found.snapshot->instance) + " " +
      std::to_string(found.snapshot->sequence);
    for (const auto & block : found.snapshot->blocks) {
      text += " " + std::string(block.begin(), block.end());
    }
  }
  text += "; " + std::to_string(found.faults.size()) + " damaged";
  return text.c_str();
}

int snapshot_write(
  const char * directory, const char * process, std::uint64_t instance, std::uint64_t sequence,
  const std::uint8_t * data, std::size_t size)
{
  return guarded(
    [&] {
      SnapshotWriter writer(directory);
      return writer.write({process, instance, sequence, {bytes_of(data, size)}, ""}) ? 1 : 0;
    });
}
}
