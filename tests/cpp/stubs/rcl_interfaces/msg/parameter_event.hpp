// Declarations that mirror rcl_interfaces of Jazzy; see ../../README.md.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "stub_archive.hpp"

namespace rcl_interfaces::msg
{

struct ParameterValue
{
  std::uint8_t type = 0;
  std::int64_t integer_value = 0;
};

struct Parameter
{
  std::string name;
  ParameterValue value;
};

inline void stub_write(StubBytes & out, const Parameter & one)
{
  ::stub_write(out, one.name);
  ::stub_write(out, static_cast<std::int64_t>(one.value.type));
  ::stub_write(out, one.value.integer_value);
}

inline void stub_read(const StubBytes & in, std::size_t & at, Parameter & one)
{
  std::int64_t type = 0;
  ::stub_read(in, at, one.name);
  ::stub_read(in, at, type);
  ::stub_read(in, at, one.value.integer_value);
  one.value.type = static_cast<std::uint8_t>(type);
}

struct ParameterEvent
{
  std::string node;
  std::vector<Parameter> new_parameters;
  std::vector<Parameter> changed_parameters;
  std::vector<Parameter> deleted_parameters;
};

inline void stub_write(StubBytes & out, const ParameterEvent & event)
{
  ::stub_write(out, event.node);
  ::stub_write(out, event.new_parameters);
  ::stub_write(out, event.changed_parameters);
}

inline void stub_read(const StubBytes & in, std::size_t & at, ParameterEvent & event)
{
  ::stub_read(in, at, event.node);
  ::stub_read(in, at, event.new_parameters);
  ::stub_read(in, at, event.changed_parameters);
}

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
