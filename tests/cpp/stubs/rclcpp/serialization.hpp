// Declarations that mirror rclcpp 28.1.6, and a double that behaves alike; see ../README.md.
#pragma once

#include <cstdint>
#include <stdexcept>
#include <type_traits>
#include <vector>

#include "rclcpp/serialized_message.hpp"

namespace rclcpp
{

template<typename MessageT>
class Serialization
{
public:
  void serialize_message(const void * message, SerializedMessage * serialized) const
  {
    std::vector<std::uint8_t> content{0, 1, 0, 0};
    stub_write(content, *static_cast<const MessageT *>(message));
    serialized->stub_assign(std::move(content));
  }

  void deserialize_message(const SerializedMessage * serialized, void * message) const
  {
    const auto & content = serialized->stub_content();
    if (content.empty()) {
      throw std::invalid_argument("Serialized message has a capacity of zero.");
    }
    std::size_t at = 4;
    stub_read(content, at, *static_cast<MessageT *>(message));
  }
};

}  // namespace rclcpp
