// Declarations that mirror rclcpp 28.1.6; see ../README.md.
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
    const std::shared_ptr<node_interfaces::NodeServicesInterface> node_services,
    node_interfaces::NodeParametersInterface * node_parameters,
    const QoS & qos = ParametersQoS());
};

}  // namespace rclcpp
