#include "rosrm_node_cpp/core/sealing.hpp"

#include <sodium.h>

#include <algorithm>
#include <cstring>
#include <stdexcept>
#include <utility>

#include "rosrm_node_cpp/core/cdr.hpp"

namespace rosrm_node
{

namespace
{

constexpr std::uint8_t kFormat = 1;
/// Bytes that sealing adds.
constexpr std::size_t kTagBytes = 16;
/// Most runs and channels whose newest counters are stored.
constexpr std::size_t kMostOpeners = 256;

using Personalisation = std::array<unsigned char, 16>;

Personalisation padded(const char * text)
{
  Personalisation bytes{};
  std::memcpy(bytes.data(), text, std::min(std::strlen(text), bytes.size()));
  return bytes;
}

template<std::size_t size>
std::array<std::uint8_t, size> digest_of(
  const Bytes & input, const Key * key, const char * personalisation)
{
  std::array<std::uint8_t, size> digest;
  const auto person = padded(personalisation);
  const int failed = crypto_generichash_blake2b_salt_personal(
    digest.data(), size, input.data(), input.size(), key ? key->data() : nullptr,
    key ? key->size() : 0, nullptr, person.data());
  if (failed != 0) {
    throw std::runtime_error("BLAKE2b failed");
  }
  return digest;
}

/// Append an argument of a derivation, after its length.
template<typename Container>
void append(Bytes & input, const Container & argument)
{
  for (int byte = 0; byte < 4; ++byte) {
    input.push_back(static_cast<std::uint8_t>(argument.size() >> (8 * byte)));
  }
  input.insert(input.end(), argument.begin(), argument.end());
}

std::array<std::uint8_t, 12> nonce_of(std::uint64_t counter)
{
  std::array<std::uint8_t, 12> nonce{};
  for (std::size_t byte = 0; byte < 8; ++byte) {
    nonce[4 + byte] = static_cast<std::uint8_t>(counter >> (8 * byte));
  }
  return nonce;
}

Run random_run()
{
  if (sodium_init() < 0) {
    throw std::runtime_error("libsodium cannot be initialised");
  }
  Run run;
  randombytes_buf(run.data(), run.size());
  return run;
}

}  // namespace

ChannelId channel_of(const std::string & topic, const std::string & type)
{
  Bytes input(topic.begin(), topic.end());
  input.push_back(0);
  input.insert(input.end(), type.begin(), type.end());
  return digest_of<16>(input, nullptr, "rosrm channel");
}

Key key_of(const Bytes & bytes)
{
  Key key;
  if (bytes.size() != key.size()) {
    throw std::invalid_argument(
            "a key has " + std::to_string(bytes.size()) + " bytes, not " +
            std::to_string(kKeyBytes));
  }
  std::copy(bytes.begin(), bytes.end(), key.begin());
  return key;
}

Link::Link(std::optional<Key> key, std::string outward, std::string inward)
: key_(std::move(key)), outward_(std::move(outward)), inward_(std::move(inward)),
  run_(random_run())
{
}

Key Link::key_for(
  const std::string & direction, const Run & run, const ChannelId & channel) const
{
  Bytes input;
  append(input, direction);
  append(input, run);
  append(input, channel);
  return digest_of<kKeyBytes>(input, &*key_, "rosrm keys 1");
}

Sealed Link::seal(const ChannelId & channel, const Bytes & plain)
{
  auto found = sealers_.find(channel);
  if (found == sealers_.end()) {
    const auto key = key_ ? key_for(outward_, run_, channel) : Key{};
    found = sealers_.emplace(channel, Sealer{key, 0}).first;
  }
  Sealer & sealer = found->second;
  Sealed sealed;
  sealed.run = run_;
  sealed.counter = ++sealer.counter;
  if (!key_) {
    sealed.body = plain;
    return sealed;
  }
  sealed.body.resize(plain.size() + kTagBytes);
  const auto nonce = nonce_of(sealed.counter);
  crypto_aead_chacha20poly1305_ietf_encrypt(
    sealed.body.data(), nullptr, plain.data(), plain.size(), sealed.receiver_run.data(),
    sealed.receiver_run.size(), nullptr, nonce.data(), sealer.key.data());
  return sealed;
}

std::optional<Bytes> Link::open(const ChannelId & channel, const Sealed & sealed)
{
  if (sealed.run == run_) {
    return std::nullopt;  // both directions of a handoff have one key
  }
  if (!key_) {
    return sealed.body;
  }
  const auto known = std::find_if(
    openers_.begin(), openers_.end(), [&](const Opener & one) {
      return one.run == sealed.run && one.channel == channel;
    });
  Opener opener = known != openers_.end() ? *known :
    Opener{sealed.run, channel, key_for(inward_, sealed.run, channel), 0};
  if (sealed.counter <= opener.newest || sealed.body.size() < kTagBytes) {
    return std::nullopt;
  }
  Bytes plain(sealed.body.size() - kTagBytes);
  const auto nonce = nonce_of(sealed.counter);
  const int forged = crypto_aead_chacha20poly1305_ietf_decrypt(
    plain.data(), nullptr, nullptr, sealed.body.data(), sealed.body.size(),
    sealed.receiver_run.data(), sealed.receiver_run.size(), nonce.data(), opener.key.data());
  if (forged != 0) {
    return std::nullopt;
  }
  opener.newest = sealed.counter;
  if (known != openers_.end()) {
    openers_.erase(known);
  }
  openers_.push_back(opener);
  if (openers_.size() > kMostOpeners) {
    openers_.erase(openers_.begin());
  }
  return plain;
}

SealedTopic::SealedTopic(
  std::shared_ptr<Link> link, std::string principal, const std::string & topic,
  const std::string & type)
: link_(std::move(link)), principal_(std::move(principal)), name_(topic),
  channel_(channel_of(topic, type))
{
}

Bytes SealedTopic::seal(const Bytes & plain)
{
  Sealed sealed = link_->seal(channel_, plain);
  sealed.principal = principal_;
  return encoded(sealed);
}

std::optional<Bytes> SealedTopic::open(const Bytes & data)
{
  try {
    const Sealed sealed = decoded_sealed(data);
    if (sealed.format != kFormat || sealed.principal != principal_) {
      return std::nullopt;
    }
    return link_->open(channel_, sealed);
  } catch (const Malformed &) {
    return std::nullopt;
  }
}

}  // namespace rosrm_node
