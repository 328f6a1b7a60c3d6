// Declarations that mirror rcl_interfaces of Jazzy; see ../../README.md.
#pragma once

#include <string>
#include <vector>

namespace rcl_interfaces::msg
{

struct Parameter
{
  std::string name;
};

struct ParameterEvent
{
  std::string node;
  std::vector<Parameter> new_parameters;
  std::vector<Parameter> changed_parameters;
  std::vector<Parameter> deleted_parameters;
};

struct SetParametersResult
{
  bool successful = false;
  std::string reason;
};

struct ListParametersResult
{
  std::vector<std::string> names;
  std::vector<std::string> prefixes;
};

}  // namespace rcl_interfaces::msg
