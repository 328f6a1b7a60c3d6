// Form of the messages of the double: fields one after the other, without padding.
#pragma once

#include <cstdint>
#include <stdexcept>
#include <string>
#include <vector>

using StubBytes = std::vector<std::uint8_t>;

inline void stub_write(StubBytes & out, std::int64_t value)
{
  for (int byte = 0; byte < 8; ++byte) {
    out.push_back(static_cast<std::uint8_t>(value >> (8 * byte)));
  }
}

inline void stub_read(const StubBytes & in, std::size_t & at, std::int64_t & value)
{
  if (in.size() < at + 8) {
    throw std::runtime_error("Failed to deserialize ROS message.");
  }
  std::uint64_t bits = 0;
  for (int byte = 0; byte < 8; ++byte) {
    bits |= static_cast<std::uint64_t>(in[at++]) << (8 * byte);
  }
  value = static_cast<std::int64_t>(bits);
}

inline void stub_write(StubBytes & out, const std::string & text)
{
  stub_write(out, static_cast<std::int64_t>(text.size()));
  out.insert(out.end(), text.begin(), text.end());
}

inline void stub_read(const StubBytes & in, std::size_t & at, std::string & text)
{
  std::int64_t size = 0;
  stub_read(in, at, size);
  if (in.size() < at + static_cast<std::size_t>(size)) {
    throw std::runtime_error("Failed to deserialize ROS message.");
  }
  const auto begin = in.begin() + static_cast<std::ptrdiff_t>(at);
  text.assign(begin, begin + size);
  at += static_cast<std::size_t>(size);
}

template<typename T>
void stub_write(StubBytes & out, const std::vector<T> & list)
{
  stub_write(out, static_cast<std::int64_t>(list.size()));
  for (const auto & one : list) {
    stub_write(out, one);
  }
}

template<typename T>
void stub_read(const StubBytes & in, std::size_t & at, std::vector<T> & list)
{
  std::int64_t size = 0;
  stub_read(in, at, size);
  list.clear();
  for (; size > 0; --size) {
    list.emplace_back();
    stub_read(in, at, list.back());
  }
}
