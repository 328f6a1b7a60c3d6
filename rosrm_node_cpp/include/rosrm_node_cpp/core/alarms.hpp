/// \file
/// Repeated calls by the monotonic clock, all on one timer of the middleware.
#pragma once

#include <functional>
#include <map>

#include "rosrm_node_cpp/core/middleware.hpp"

namespace rosrm_node
{

class Alarms
{
public:
  explicit Alarms(Middleware & middleware)
  : middleware_(middleware) {}

  /// Call a function every `period` seconds; return the number of the alarm, which is above 0.
  int start(double period, std::function<void()> call);

  /// Stop an alarm, and set its number to 0.
  void stop(int & number);

  /// Run all calls that are due. An exception of a call is passed on; its alarm continues.
  void wake();

private:
  struct Alarm
  {
    double due;
    double period;
    std::function<void()> call;
  };

  void arm();

  Middleware & middleware_;
  std::map<int, Alarm> alarms_;
  int last_ = 0;
};

}  // namespace rosrm_node
