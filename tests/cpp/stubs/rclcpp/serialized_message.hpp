// Declarations that mirror rclcpp 28.1.6, and a double that behaves alike; see ../README.md.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

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
  SerializedMessage() {get_rcl_serialized_message();}
  explicit SerializedMessage(std::size_t capacity)
  : content_(capacity) {get_rcl_serialized_message();}
  SerializedMessage(const SerializedMessage & other)
  : content_(other.content_) {get_rcl_serialized_message();}
  virtual ~SerializedMessage() = default;

  rcl_serialized_message_t & get_rcl_serialized_message()
  {
    raw_ = {content_.data(), content_.size(), content_.size()};
    return raw_;
  }
  const rcl_serialized_message_t & get_rcl_serialized_message() const {return raw_;}

  void stub_assign(std::vector<std::uint8_t> content)
  {
    content_ = std::move(content);
    get_rcl_serialized_message();
  }
  const std::vector<std::uint8_t> & stub_content() const {return content_;}

private:
  std::vector<std::uint8_t> content_;
  rcl_serialized_message_t raw_{};
};

}  // namespace rclcpp
