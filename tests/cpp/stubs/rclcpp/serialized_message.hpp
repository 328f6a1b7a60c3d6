// Declarations that mirror rclcpp 28.1.6; see ../README.md.
#pragma once

#include <cstddef>
#include <cstdint>

struct rcl_serialized_message_t
{
  std::uint8_t * buffer;
  std::size_t buffer_length;
  std::size_t buffer_capacity;
};

namespace rclcpp
{

class SerializedMessage
{
public:
  SerializedMessage();
  explicit SerializedMessage(std::size_t capacity);
  SerializedMessage(const SerializedMessage & other);
  SerializedMessage(SerializedMessage && other);
  virtual ~SerializedMessage();
  rcl_serialized_message_t & get_rcl_serialized_message();
  const rcl_serialized_message_t & get_rcl_serialized_message() const;
};

}  // namespace rclcpp
