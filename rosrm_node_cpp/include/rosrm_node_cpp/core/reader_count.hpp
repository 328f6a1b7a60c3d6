/// \file
/// Number of the readers of an output that a successor must reach.
#pragma once

#include <algorithm>
#include <chrono>
#include <cstddef>
#include <cstdint>

namespace rosrm_node
{

/// Counts the readers of one output that a successor must reach: those of no slave.
///
/// A slave reads topics for health checks and measured rates, and loses nothing in a handoff. A
/// killed slave stays in the graph of its peers for long, and a new shadow never discovers it.
class ReaderCount
{
public:
  /// Return the number of matched readers that belong to no slave.
  /// \param count_slaves looks in the graph. Node names may arrive later than the readers, so it is
  ///   called once a second, and when the number of readers has changed.
  template<typename CountT>
  std::uint32_t of(std::size_t matched, CountT count_slaves)
  {
    const auto now = std::chrono::steady_clock::now();
    if (matched != matched_ || now - counted_at_ >= std::chrono::seconds(1)) {
      slaves_ = matched ? count_slaves() : 0;
      matched_ = matched;
      counted_at_ = now;
    }
    return static_cast<std::uint32_t>(matched - std::min(matched, slaves_));
  }

private:
  std::size_t matched_ = 0;
  std::size_t slaves_ = 0;
  std::chrono::steady_clock::time_point counted_at_{};
};

}  // namespace rosrm_node
