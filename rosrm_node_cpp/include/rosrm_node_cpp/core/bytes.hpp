/// \file
/// Byte strings and their CRC-32.
#pragma once

#include <cstdint>
#include <vector>

namespace rosrm_node
{

using Bytes = std::vector<std::uint8_t>;

/// Return the CRC-32 of zlib and PNG.
std::uint32_t crc32(const std::uint8_t * data, std::size_t size);

inline std::uint32_t crc32(const Bytes & data)
{
  return crc32(data.data(), data.size());
}

}  // namespace rosrm_node
