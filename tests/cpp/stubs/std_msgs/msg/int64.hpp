// Declarations that mirror std_msgs of Jazzy; see ../../README.md.
#pragma once

#include <cstdint>

#include "stub_archive.hpp"

namespace std_msgs::msg
{

struct Int64
{
  std::int64_t data = 0;
};

inline void stub_write(StubBytes & out, const Int64 & one) {::stub_write(out, one.data);}

inline void stub_read(const StubBytes & in, std::size_t & at, Int64 & one)
{
  ::stub_read(in, at, one.data);
}

}  // namespace std_msgs::msg
