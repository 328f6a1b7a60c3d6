/// \file
/// Little-endian plain CDR with its header of 4 bytes: the form of all messages of the protocol.
///
/// The core writes and reads it without ROS types, because sealing encrypts exactly these bytes.
#pragma once

#include <algorithm>
#include <array>
#include <cstring>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "rosrm_node_cpp/core/bytes.hpp"

namespace rosrm_node
{

/// Bytes that are no message of the expected type.
class Malformed : public std::runtime_error
{
public:
  using std::runtime_error::runtime_error;
};

/// Writer of one message.
class CdrWriter
{
public:
  CdrWriter()
  : data_{0, 1, 0, 0} {}

  template<typename T>
  void number(T value)
  {
    static_assert(std::is_integral_v<T>);
    align(sizeof(T));
    for (std::size_t byte = 0; byte < sizeof(T); ++byte) {
      data_.push_back(
        static_cast<std::uint8_t>(static_cast<std::make_unsigned_t<T>>(value) >> (8 * byte)));
    }
  }

  void boolean(bool value) {data_.push_back(value ? 1 : 0);}

  void text(const std::string & value)
  {
    number(static_cast<std::uint32_t>(value.size() + 1));
    raw(reinterpret_cast<const std::uint8_t *>(value.c_str()), value.size() + 1);
  }

  void raw(const std::uint8_t * data, std::size_t size)
  {
    data_.insert(data_.end(), data, data + size);
  }

  void blob(const Bytes & value)
  {
    number(static_cast<std::uint32_t>(value.size()));
    raw(value.data(), value.size());
  }

  template<typename T, typename Write>
  void list(const std::vector<T> & values, Write write)
  {
    number(static_cast<std::uint32_t>(values.size()));
    for (const auto & value : values) {
      write(value);
    }
  }

  void reserve(std::size_t size) {data_.reserve(size);}

  Bytes take() {return std::move(data_);}

private:
  void align(std::size_t size)
  {
    while ((data_.size() - 4) % size != 0) {
      data_.push_back(0);
    }
  }

  Bytes data_;
};

/// Reader of one message. Each method throws `Malformed` if the bytes end early.
class CdrReader
{
public:
  explicit CdrReader(const Bytes & data)
  : data_(data)
  {
    if (data.size() < 4 || data[0] != 0 || data[1] != 1) {
      throw Malformed("it is not in little-endian CDR");
    }
  }

  template<typename T>
  T number()
  {
    static_assert(std::is_integral_v<T>);
    at_ += padding(sizeof(T));
    need(sizeof(T));
    std::make_unsigned_t<T> value = 0;
    for (std::size_t byte = 0; byte < sizeof(T); ++byte) {
      value = static_cast<std::make_unsigned_t<T>>(
        value | static_cast<std::make_unsigned_t<T>>(data_[at_ + byte]) << (8 * byte));
    }
    at_ += sizeof(T);
    return static_cast<T>(value);
  }

  bool boolean() {return number<std::uint8_t>() != 0;}

  std::string text()
  {
    const auto size = number<std::uint32_t>();
    need(size);
    std::string value(reinterpret_cast<const char *>(data_.data() + at_), size);
    at_ += size;
    while (!value.empty() && value.back() == '\0') {
      value.pop_back();
    }
    return value;
  }

  template<std::size_t size>
  void raw(std::array<std::uint8_t, size> & into)
  {
    need(size);
    std::memcpy(into.data(), data_.data() + at_, size);
    at_ += size;
  }

  Bytes blob()
  {
    const auto size = number<std::uint32_t>();
    need(size);
    const auto begin = data_.begin() + static_cast<std::ptrdiff_t>(at_);
    at_ += size;
    return Bytes(begin, begin + size);
  }

  template<typename T, typename Read>
  std::vector<T> list(Read read)
  {
    const auto count = number<std::uint32_t>();
    need(count);  // each element has at least a byte
    std::vector<T> values;
    values.reserve(std::min<std::size_t>(count, 1024));  // a forged count allocates no memory
    for (std::uint32_t index = 0; index < count; ++index) {
      values.push_back(read());
    }
    return values;
  }

private:
  std::size_t padding(std::size_t size) const {return (size - (at_ - 4) % size) % size;}

  void need(std::size_t size) const
  {
    if (data_.size() < at_ || data_.size() - at_ < size) {
      throw Malformed("it ends early");
    }
  }

  const Bytes & data_;
  std::size_t at_ = 4;
};

}  // namespace rosrm_node
