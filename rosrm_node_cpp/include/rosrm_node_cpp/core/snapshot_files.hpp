/// \file
/// Files of a node's last published state: format, newest file, and writing in turn.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "rosrm_node_cpp/core/bytes.hpp"

namespace rosrm_node
{

/// A complete snapshot.
struct Snapshot
{
  std::string process;
  std::uint64_t instance = 0;
  std::uint64_t sequence = 0;
  /// The mark, then each part of the state, serialised.
  std::vector<Bytes> blocks;
  std::string path;
};

/// The newest snapshot of a process, and the faults of damaged files.
struct FoundSnapshot
{
  std::optional<Snapshot> snapshot;
  std::vector<std::string> faults;
};

/// A file holds no complete snapshot.
class Damaged : public std::runtime_error
{
public:
  using std::runtime_error::runtime_error;
};

/// Return the content of a file with a snapshot.
Bytes encoded(const Snapshot & snapshot);

/// Return the snapshot in the content of a file.
/// \throws Damaged the content is no complete snapshot.
Snapshot decoded_snapshot(const Bytes & data);

/// Return the newest complete snapshot of instances up to a number.
FoundSnapshot newest_snapshot(const std::string & directory, std::uint64_t up_to);

/// Writer of a node's snapshots into its two files in turn, never over the newest one.
class SnapshotWriter
{
public:
  /// \param directory of the process; created if it does not exist.
  explicit SnapshotWriter(std::string directory);
  ~SnapshotWriter();
  SnapshotWriter(const SnapshotWriter &) = delete;
  SnapshotWriter & operator=(const SnapshotWriter &) = delete;

  /// Overwrite the older snapshot. Return false, with nothing changed, if a newer instance writes
  /// here.
  /// \throws std::system_error the snapshot cannot be written; the newer one is still complete.
  bool write(const Snapshot & snapshot);

private:
  void open();
  void close();
  bool are_deleted() const;

  std::string directory_;
  std::array<int, 2> files_{-1, -1};
  std::size_t next_ = 0;
};

}  // namespace rosrm_node
