// Declarations that mirror rclcpp 28.1.6; see ../README.md.
#pragma once

#include "rclcpp/serialized_message.hpp"

namespace rclcpp
{

template<typename MessageT>
class Serialization
{
public:
  void serialize_message(const void * message, SerializedMessage * serialized) const;
  void deserialize_message(const SerializedMessage * serialized, void * message) const;
};

}  // namespace rclcpp
