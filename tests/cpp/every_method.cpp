// Calls each method of `rosrm_node::Node` once, so that the compiler checks its template.

#include <memory>

#include "rosrm_node_cpp/node.hpp"
#include "std_msgs/msg/int64.hpp"

using std_msgs::msg::Int64;

struct Trigger
{
  struct Request {};
  struct Response
  {
    bool success = false;
  };
};

class EveryMethod : public rosrm_node::Node
{
public:
  EveryMethod()
  : Node("every_method")
  {
    output_ = create_publisher<Int64>("count", rclcpp::QoS(10));
    input_ = create_subscription<Int64>(
      "add", 10, [this](const Int64 & message) {output_->publish(message);}, false);
    timer_ = create_timer(std::chrono::milliseconds(100), [this] {timer_->cancel();});
    create_service<Trigger>(
      "~/poke", [](auto, std::shared_ptr<Trigger::Response> response) {
        response->success = true;
      });
    client_ = create_client<Trigger>("~/poke");
    when_active([] {return std::make_shared<int>(1);});
    keep_state<Int64>(
      "~/state", []() -> std::optional<Int64> {return std::nullopt;}, [](const Int64 &) {});
    output_->publish(std::make_unique<Int64>());
  }

private:
  rosrm_node::Publisher<Int64>::SharedPtr output_;
  rclcpp::Subscription<Int64>::SharedPtr input_;
  rosrm_node::Timer::SharedPtr timer_;
  rclcpp::Client<Trigger>::SharedPtr client_;
};

int main() {EveryMethod node;}
