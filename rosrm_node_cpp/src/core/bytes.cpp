#include "rosrm_node_cpp/core/bytes.hpp"

#include <array>

namespace rosrm_node
{

namespace
{

/// Tables for eight bytes at a time: a state may have hundreds of megabytes.
using Tables = std::array<std::array<std::uint32_t, 256>, 8>;

Tables made_tables()
{
  Tables tables{};
  for (std::uint32_t byte = 0; byte < 256; ++byte) {
    std::uint32_t value = byte;
    for (int bit = 0; bit < 8; ++bit) {
      value = (value >> 1) ^ ((value & 1u) ? 0xEDB88320u : 0u);
    }
    tables[0][byte] = value;
  }
  for (std::uint32_t byte = 0; byte < 256; ++byte) {
    for (std::size_t table = 1; table < tables.size(); ++table) {
      const auto before = tables[table - 1][byte];
      tables[table][byte] = (before >> 8) ^ tables[0][before & 0xFFu];
    }
  }
  return tables;
}

}  // namespace

std::uint32_t crc32(const std::uint8_t * data, std::size_t size)
{
  static const Tables tables = made_tables();
  std::uint32_t value = 0xFFFFFFFFu;
  for (; size >= 8; data += 8, size -= 8) {
    const std::uint32_t low = value ^ (data[0] | data[1] << 8 | data[2] << 16 |
      static_cast<std::uint32_t>(data[3]) << 24);
    value = tables[7][low & 0xFFu] ^ tables[6][(low >> 8) & 0xFFu] ^
      tables[5][(low >> 16) & 0xFFu] ^ tables[4][low >> 24] ^
      tables[3][data[4]] ^ tables[2][data[5]] ^ tables[1][data[6]] ^ tables[0][data[7]];
  }
  for (; size > 0; ++data, --size) {
    value = (value >> 8) ^ tables[0][(value ^ *data) & 0xFFu];
  }
  return ~value;
}

}  // namespace rosrm_node
