/// \file
/// What the core needs from ROS: topics of bytes, a clock, one timer and a log.
#pragma once

#include <optional>
#include <string>

#include "rosrm_node_cpp/core/bytes.hpp"

namespace rosrm_node
{

enum class Severity {kInfo, kWarning, kError};

/// Interface that `rosrm_node::Node` implements by rclcpp.
///
/// All entities have the type `rosrm_msgs/msg/Sealed`, and are reliable, transient local and of
/// history keep last. Messages are in CDR.
class Middleware
{
public:
  virtual ~Middleware() = default;

  /// Return the monotonic time in seconds.
  virtual double now() = 0;

  /// Call `HandoffSession::wake` once after some seconds; a later call replaces the time.
  virtual void wake_in(double seconds) = 0;

  /// Return true after the shutdown of ROS, when its calls fail.
  virtual bool is_shut_down() {return false;}

  virtual void log(Severity severity, const std::string & text) = 0;

  /// Create a publisher; return its number.
  /// \throws std::exception the topic cannot be published.
  virtual int open_writer(const std::string & topic, std::size_t depth) = 0;

  /// Create a subscription; return its number. Each message is given to `HandoffSession::received`.
  /// \throws std::exception the topic cannot be subscribed to.
  virtual int open_reader(const std::string & topic, std::size_t depth) = 0;

  /// Destroy a publisher or a subscription.
  virtual void close(int entity) = 0;

  virtual void publish(int writer, const Bytes & message) = 0;

  /// Return a message that waits at a subscription; none: no message waits.
  virtual std::optional<Bytes> take(int reader) = 0;
};

}  // namespace rosrm_node
