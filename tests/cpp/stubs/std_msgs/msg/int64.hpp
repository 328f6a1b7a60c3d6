// Declarations that mirror std_msgs of Jazzy; see ../../README.md.
#pragma once

#include <cstdint>

namespace std_msgs::msg
{

struct Int64
{
  std::int64_t data = 0;
};

}  // namespace std_msgs::msg
