#include "rosrm_node_cpp/core/identity.hpp"

#include <cctype>
#include <cstdlib>
#include <fstream>
#include <stdexcept>

namespace rosrm_node
{

namespace
{

/// Maximum size in bytes of the file with the key of an instance.
constexpr std::streamsize kLongestKey = 64;
/// Most digits of an epoch.
constexpr std::streamsize kEpochDigits = 20;

std::optional<std::uint64_t> number_in(const std::string & text)
{
  if (text.empty() || text.size() > kEpochDigits) {
    return std::nullopt;
  }
  std::uint64_t number = 0;
  for (const char letter : text) {
    const auto digit = static_cast<std::uint64_t>(letter - '0');
    if (letter < '0' || letter > '9' || number > (UINT64_MAX - digit) / 10) {
      return std::nullopt;
    }
    number = number * 10 + digit;
  }
  return number;
}

int sextet_of(char letter)
{
  static const std::string letters =
    "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
  const auto at = letters.find(letter);
  return at == std::string::npos ? -1 : static_cast<int>(at);
}

Bytes from_base64(const std::string & text)
{
  Bytes bytes;
  unsigned value = 0;
  int bits = 0;
  for (const char letter : text.substr(0, text.find('='))) {
    const int sextet = sextet_of(letter);
    if (sextet < 0) {
      throw std::invalid_argument("not in base64");
    }
    value = value << 6 | static_cast<unsigned>(sextet);
    bits += 6;
    if (bits >= 8) {
      bits -= 8;
      bytes.push_back(static_cast<std::uint8_t>(value >> bits));
    }
  }
  return bytes;
}

std::optional<Key> instance_key(std::string text, const std::string & path)
{
  if (text.empty() && path.empty()) {
    return std::nullopt;
  }
  if (text.empty()) {
    std::ifstream file(path);
    text.assign(kLongestKey, '\0');
    file.read(text.data(), kLongestKey);
    text.resize(static_cast<std::size_t>(file.gcount()));
  }
  try {
    return key_of(from_base64(text));
  } catch (const std::invalid_argument &) {
    // Without a key the node would accept all messages.
    throw std::invalid_argument(
      "the key of the instance must have 32 bytes in base64" +
      (path.empty() ? std::string() : ", in the file " + path));
  }
}

double seconds_in(const std::string & text)
{
  constexpr double kDefault = 1.0;
  try {
    const double seconds = std::stod(text);
    return seconds >= 0.0 && seconds < 1e9 ? seconds : kDefault;
  } catch (const std::exception &) {
    return kDefault;
  }
}

}  // namespace

std::string NodeIdentity::name_space() const
{
  return state_config.substr(0, state_config.rfind('/'));
}

std::optional<std::uint64_t> NodeIdentity::registered_epoch() const
{
  std::ifstream file(epoch_file);
  std::string digits(kEpochDigits, '\0');
  file.read(digits.data(), kEpochDigits);
  digits.resize(static_cast<std::size_t>(file.gcount()));
  return number_in(digits.substr(0, digits.find('\n')));
}

Environment process_environment()
{
  return [](const char * name) {
           const char * value = std::getenv(name);
           return std::string(value == nullptr ? "" : value);
         };
}

std::optional<NodeIdentity> identity_from(const Environment & environment)
{
  const std::string instance = environment("ROSRM_INSTANCE");
  const auto hash = instance.rfind('#');
  if (hash == std::string::npos || hash == 0) {
    return std::nullopt;
  }
  const auto number = number_in(instance.substr(hash + 1));
  NodeIdentity identity;
  identity.state_config = environment("ROSRM_STATE_CONFIG");
  if (!number || identity.state_config.empty()) {
    return std::nullopt;
  }
  identity.process = instance.substr(0, hash);
  identity.instance = *number;
  identity.node = environment("ROSRM_NODE");
  identity.cluster = environment("ROSRM_MASTER");
  identity.epoch = number_in(environment("ROSRM_EPOCH")).value_or(0);
  identity.shadow = environment("ROSRM_SHADOW") == "1";
  identity.keep = environment("ROSRM_KEEP");
  identity.keep_every = seconds_in(environment("ROSRM_KEEP_EVERY"));
  identity.epoch_file = environment("ROSRM_EPOCH_FILE");
  identity.key =
    instance_key(environment("ROSRM_INSTANCE_KEY"), environment("ROSRM_INSTANCE_KEY_FILE"));
  return identity;
}

}  // namespace rosrm_node
