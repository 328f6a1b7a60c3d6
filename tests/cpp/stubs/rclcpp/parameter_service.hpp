// Declarations that mirror rclcpp 28.1.6, and a double that behaves alike; see ../README.md.
#pragma once

#include <memory>

#include "rclcpp/rclcpp.hpp"

namespace rclcpp
{

class ParameterService
{
public:
  ParameterService(
    const std::shared_ptr<node_interfaces::NodeBaseInterface> node_base,
    const std::shared_ptr<node_interfaces::NodeServicesInterface>,
    node_interfaces::NodeParametersInterface *, const QoS & = ParametersQoS())
  {
    node_base->get_context()->stub_check();
    ++stub_parameter_services;
  }
  ~ParameterService() {--stub_parameter_services;}
};

}  // namespace rclcpp
