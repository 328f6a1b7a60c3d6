/// \file
/// A counter that migrates from host to host and never loses count.

#include <chrono>
#include <memory>

#include "rclcpp/rclcpp.hpp"
#include "rosrm_node_cpp/node.hpp"
#include "std_msgs/msg/int64.hpp"

using std_msgs::msg::Int64;

/// A node that publishes 1, 2, 3, ... on `count`, ten times a second.
class Counter : public rosrm_node::Node
{
public:
  /// Begin at 0; a successor restores the state of the node before it.
  Counter()
  : Node("counter"), output_(create_publisher<Int64>("count", 10)),
    timer_(create_wall_timer(std::chrono::milliseconds(100), [this] {tick();}))
  {
    keep_state<Int64>(
      "~/state", [this] {return count_;}, [this](const Int64 & state) {count_ = state;});
  }

private:
  /// Increment the count, and publish it.
  void tick()
  {
    ++count_.data;
    output_->publish(count_);
  }

  Int64 count_;
  rosrm_node::Publisher<Int64>::SharedPtr output_;
  rosrm_node::Timer::SharedPtr timer_;
};

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<Counter>());
  rclcpp::shutdown();
  return 0;
}
