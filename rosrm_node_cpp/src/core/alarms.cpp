#include "rosrm_node_cpp/core/alarms.hpp"

#include <algorithm>
#include <utility>
#include <vector>

namespace rosrm_node
{

int Alarms::start(double period, std::function<void()> call)
{
  alarms_[++last_] = {middleware_.now() + period, period, std::move(call)};
  arm();
  return last_;
}

void Alarms::stop(int & number)
{
  alarms_.erase(std::exchange(number, 0));
}

void Alarms::wake()
{
  const double now = middleware_.now();
  std::vector<int> due;
  for (auto & [number, alarm] : alarms_) {
    if (alarm.due <= now) {
      due.push_back(number);
      alarm.due = now + alarm.period;
    }
  }
  arm();  // before the calls, because one of them may throw
  for (const int number : due) {
    const auto found = alarms_.find(number);
    if (found != alarms_.end()) {
      const auto call = found->second.call;  // the call may stop its alarm
      call();
    }
  }
}

void Alarms::arm()
{
  if (alarms_.empty()) {
    return;
  }
  const auto next = std::min_element(
    alarms_.begin(), alarms_.end(), [](const auto & one, const auto & other) {
      return one.second.due < other.second.due;
    });
  middleware_.wake_in(std::max(0.0, next->second.due - middleware_.now()));
}

}  // namespace rosrm_node
