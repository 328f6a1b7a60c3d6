// Declarations of the functions of libsodium 1.0.18 that rosrm_node_cpp calls. The tests compile
// against this header, and link the libsodium that PyNaCl contains.
#pragma once

#include <cstddef>

extern "C" {
int sodium_init(void);
void randombytes_buf(void * buffer, std::size_t size);

int crypto_generichash_blake2b_salt_personal(
  unsigned char * out, std::size_t out_size, const unsigned char * in, unsigned long long in_size,
  const void * key, std::size_t key_size, const void * salt, const void * personal);

int crypto_aead_chacha20poly1305_ietf_encrypt(
  unsigned char * cipher, unsigned long long * cipher_size, const unsigned char * message,
  unsigned long long message_size, const unsigned char * data, unsigned long long data_size,
  const unsigned char * secret_nonce, const unsigned char * nonce, const unsigned char * key);

int crypto_aead_chacha20poly1305_ietf_decrypt(
  unsigned char * message, unsigned long long * message_size, unsigned char * secret_nonce,
  const unsigned char * cipher, unsigned long long cipher_size, const unsigned char * data,
  unsigned long long data_size, const unsigned char * nonce, const unsigned char * key);
}
