#include "rosrm_node_cpp/core/snapshot_files.hpp"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <filesystem>
#include <system_error>

#include "rosrm_node_cpp/core/state_topic.hpp"

namespace rosrm_node
{

namespace
{

constexpr char kMagic[] = "rosrmKS1";
constexpr char kEncryptedMagic[] = "rosrmKE1";
constexpr std::size_t kMagicBytes = 8;
/// Magic, instance, sequence, bytes of the name, blocks.
constexpr std::size_t kFixedBytes = kMagicBytes + 8 + 8 + 4 + 4;
/// Size and CRC-32 of one block.
constexpr std::size_t kBlockBytes = 12;
constexpr std::size_t kMostBlocks = 1000;
constexpr std::uint64_t kLargest = std::uint64_t{2} << 30;
constexpr std::array<const char *, 2> kSlots{"state.0", "state.1"};
constexpr const char * kCopy = "copy";
/// Bytes that are read for a header; no header is larger.
constexpr std::size_t kHeadRoom = std::size_t{64} << 10;
constexpr int kOpenFlags = O_CLOEXEC | O_NOFOLLOW;

template<typename T>
void put(Bytes & data, T value)
{
  for (std::size_t byte = 0; byte < sizeof(T); ++byte) {
    data.push_back(static_cast<std::uint8_t>(value >> (8 * byte)));
  }
}

template<typename T>
T get(const Bytes & data, std::size_t at)
{
  T value = 0;
  for (std::size_t byte = 0; byte < sizeof(T); ++byte) {
    value |= static_cast<T>(data[at + byte]) << (8 * byte);
  }
  return value;
}

bool has_magic(const Bytes & data, const char * magic)
{
  return data.size() >= kMagicBytes && std::memcmp(data.data(), magic, kMagicBytes) == 0;
}

/// The header of a file, with the sizes and checksums of its blocks.
struct Head
{
  Snapshot snapshot;
  std::vector<std::pair<std::uint64_t, std::uint32_t>> blocks;
  std::size_t bytes = 0;
};

Head decoded_head(const Bytes & data)
{
  if (!has_magic(data, kMagic) || data.size() < kFixedBytes) {
    throw Damaged("it is no snapshot");
  }
  Head head;
  head.snapshot.instance = get<std::uint64_t>(data, kMagicBytes);
  head.snapshot.sequence = get<std::uint64_t>(data, kMagicBytes + 8);
  const std::size_t name = get<std::uint32_t>(data, kMagicBytes + 16);
  const std::size_t count = get<std::uint32_t>(data, kMagicBytes + 20);
  const std::size_t end = kFixedBytes + name + count * kBlockBytes;
  if (count > kMostBlocks || end + 4 > data.size()) {
    throw Damaged("it is no snapshot");
  }
  if (std::max(head.snapshot.instance, head.snapshot.sequence) >= kMostCycles) {
    throw Damaged("no instance has such a number, or so many cycles");
  }
  if (get<std::uint32_t>(data, end) != crc32(data.data(), end)) {
    throw Damaged("its head is damaged");
  }
  head.snapshot.process.assign(
    reinterpret_cast<const char *>(data.data()) + kFixedBytes, name);
  std::uint64_t total = 0;
  for (std::size_t at = kFixedBytes + name; at < end; at += kBlockBytes) {
    head.blocks.emplace_back(get<std::uint64_t>(data, at), get<std::uint32_t>(data, at + 8));
    total += std::min(head.blocks.back().first, kLargest);
  }
  if (total > kLargest) {
    throw Damaged("it claims to be larger than a state can be");
  }
  head.bytes = end + 4;
  return head;
}

/// Return at most some bytes of a file; empty: the file cannot be read.
/// Throws std::system_error: it cannot be opened now, but may be a snapshot.
Bytes content_of(const std::string & path, std::size_t most)
{
  const int file = ::open(path.c_str(), O_RDONLY | kOpenFlags);
  if (file < 0) {
    if (errno == EMFILE || errno == ENFILE || errno == ENOMEM) {
      throw std::system_error(errno, std::generic_category(), path);
    }
    return {};
  }
  struct stat status{};
  Bytes data;
  if (::fstat(file, &status) == 0) {
    data.resize(std::min(most, static_cast<std::size_t>(status.st_size)));
  }
  std::size_t at = 0;
  while (at < data.size()) {
    const ssize_t got = ::read(file, data.data() + at, data.size() - at);
    if (got <= 0) {
      break;
    }
    at += static_cast<std::size_t>(got);
  }
  ::close(file);
  data.resize(at);
  return data;
}

void write_all(int file, const std::uint8_t * data, std::size_t size, std::size_t at)
{
  while (size > 0) {
    const ssize_t written = ::pwrite(file, data, size, static_cast<off_t>(at));
    if (written < 0) {
      throw std::system_error(errno, std::generic_category());
    }
    data += written;
    size -= static_cast<std::size_t>(written);
    at += static_cast<std::size_t>(written);
  }
}

using Age = std::pair<std::uint64_t, std::uint64_t>;

Age age_if_whole(const std::string & path)
{
  try {
    const Snapshot snapshot = decoded_snapshot(content_of(path, kLargest));
    return {snapshot.instance, snapshot.sequence};
  } catch (const Damaged &) {
    return {0, 0};
  }
}

Bytes head_of(const Snapshot & snapshot)
{
  Bytes head(kMagic, kMagic + kMagicBytes);
  put(head, snapshot.instance);
  put(head, snapshot.sequence);
  put(head, static_cast<std::uint32_t>(snapshot.process.size()));
  put(head, static_cast<std::uint32_t>(snapshot.blocks.size()));
  head.insert(head.end(), snapshot.process.begin(), snapshot.process.end());
  for (const auto & block : snapshot.blocks) {
    put(head, static_cast<std::uint64_t>(block.size()));
    put(head, crc32(block));
  }
  put(head, crc32(head));
  return head;
}

}  // namespace

Bytes encoded(const Snapshot & snapshot)
{
  Bytes data = head_of(snapshot);
  for (const auto & block : snapshot.blocks) {
    data.insert(data.end(), block.begin(), block.end());
  }
  return data;
}

Snapshot decoded_snapshot(const Bytes & data)
{
  Head head = decoded_head(data);
  std::size_t at = head.bytes;
  for (const auto & [size, digest] : head.blocks) {
    if (data.size() - at < size) {
      throw Damaged("it ends early");
    }
    if (crc32(data.data() + at, size) != digest) {
      throw Damaged("its content does not match its checksum");
    }
    const auto begin = data.begin() + static_cast<std::ptrdiff_t>(at);
    head.snapshot.blocks.emplace_back(begin, begin + static_cast<std::ptrdiff_t>(size));
    at += size;
  }
  return head.snapshot;
}

FoundSnapshot newest_snapshot(const std::string & directory, std::uint64_t up_to)
{
  FoundSnapshot found;
  for (const std::string name : {kSlots[0], kSlots[1], kCopy}) {
    const std::string path = directory + "/" + name;
    const Bytes data = content_of(path, kLargest);
    if (data.empty() || has_magic(data, kEncryptedMagic)) {
      continue;
    }
    try {
      Snapshot snapshot = decoded_snapshot(data);
      const auto & best = found.snapshot;
      const bool is_newer = !best || Age(best->instance, best->sequence) <
        Age(snapshot.instance, snapshot.sequence);
      if (snapshot.instance <= up_to && is_newer) {
        snapshot.path = path;
        found.snapshot = std::move(snapshot);
      }
    } catch (const Damaged & fault) {
      found.faults.push_back(path + ": " + fault.what());
    }
  }
  return found;
}

SnapshotWriter::SnapshotWriter(std::string directory)
: directory_(std::move(directory))
{
  const Age first = age_if_whole(directory_ + "/" + kSlots[0]);
  const Age second = age_if_whole(directory_ + "/" + kSlots[1]);
  next_ = first <= second ? 0 : 1;
}

SnapshotWriter::~SnapshotWriter()
{
  close();
}

void SnapshotWriter::open()
{
  close();
  std::error_code failed;
  if (std::filesystem::create_directories(directory_, failed)) {
    std::filesystem::permissions(directory_, std::filesystem::perms::owner_all, failed);
  }
  for (std::size_t slot = 0; slot < files_.size(); ++slot) {
    const std::string path = directory_ + "/" + kSlots[slot];
    files_[slot] = ::open(path.c_str(), O_RDWR | O_CREAT | kOpenFlags, 0600);
    if (files_[slot] < 0) {
      throw std::system_error(errno, std::generic_category());
    }
  }
}

void SnapshotWriter::close()
{
  for (int & file : files_) {
    if (file >= 0) {
      ::close(std::exchange(file, -1));
    }
  }
}

/// Return true if the files are not open, or were deleted with the snapshots of earlier instances.
bool SnapshotWriter::are_deleted() const
{
  return std::any_of(
    files_.begin(), files_.end(), [](int file) {
      struct stat status{};
      return file < 0 || ::fstat(file, &status) != 0 || status.st_nlink == 0;
    });
}

bool SnapshotWriter::write(const Snapshot & snapshot)
{
  if (are_deleted()) {
    open();
  }
  const int file = files_[next_];
  try {
    const Head head = decoded_head(content_of(directory_ + "/" + kSlots[next_], kHeadRoom));
    if (head.snapshot.instance > snapshot.instance) {
      return false;
    }
  } catch (const Damaged &) {  // nothing to spare
  }
  const Bytes head = head_of(snapshot);
  std::size_t at = head.size();
  for (const auto & block : snapshot.blocks) {
    write_all(file, block.data(), block.size(), at);
    at += block.size();
  }
  // The header is written last, so an interrupted write never looks like the newest snapshot.
  write_all(file, head.data(), head.size(), 0);
  struct stat status{};
  if (::fstat(file, &status) == 0 && static_cast<std::size_t>(status.st_size) > 2 * at &&
    ::ftruncate(file, static_cast<off_t>(at)) != 0)
  {
    throw std::system_error(errno, std::generic_category());
  }
  next_ = 1 - next_;
  return true;
}

}  // namespace rosrm_node
