/* Recorder of what a process does to the files below a directory, for `LD_PRELOAD`.
 *
 * CRASH_ROOT is that directory, CRASH_LOG the file that gets one record for each call that has
 * succeeded, in one `writev`. A process without them, or whose log is gone, is not disturbed. A
 * record follows its call in the same thread. So what one thread tells another after a call also
 * comes after it in the log. `recording.py` reads the log.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

struct header {
  uint8_t kind;
  uint8_t flags;
  uint16_t first;  /* bytes of the first text */
  uint32_t second; /* bytes of the second text */
  uint64_t inode;
  uint64_t offset;
} __attribute__((packed));

#define REAL(name) \
  static __typeof__(&name) real; \
  if (real == NULL) real = (__typeof__(&name))dlsym(RTLD_NEXT, #name)

/* Open the log; once for each record, because programs close descriptors that they do not know. */
static int opened_log(void) {
  const char *path = getenv("CRASH_LOG");
  REAL(open);
  return path == NULL ? -1 : real(path, O_WRONLY | O_APPEND | O_CLOEXEC);
}

static void record(char kind, int flags, uint64_t inode, uint64_t offset, const char *first,
                   const void *second, size_t size) {
  int saved = errno;
  struct header header = {(uint8_t)kind, (uint8_t)flags, (uint16_t)strlen(first), (uint32_t)size,
                          inode, offset};
  struct iovec parts[3] = {{&header, sizeof header}, {(void *)first, strlen(first)},
                           {(void *)second, size}};
  REAL(writev);
  int log_file = opened_log();
  if (log_file >= 0 && real(log_file, parts, 3) < 0)
    dprintf(2, "recorder: the log cannot be written: %s\n", strerror(errno));
  if (log_file >= 0) close(log_file);
  errno = saved;
}

/* Return 1 if a path is below the root. */
static int is_below(const char *path) {
  const char *root = getenv("CRASH_ROOT");
  size_t length = root == NULL ? 0 : strlen(root);
  return length > 0 && strncmp(path, root, length) == 0 && path[length] == '/';
}

/* Write the path of a descriptor; return 0 if it has none. */
static int path_of(int file, char *path) {
  char link[32];
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t length = readlink(link, path, PATH_MAX - 1);
  path[length < 0 ? 0 : length] = '\0';
  return length > 0;
}

/* Return 1, with its inode, if a descriptor is a file or directory with a name below the root. */
static int is_watched(int file, uint64_t *inode) {
  int saved = errno, watched = 0;
  char path[PATH_MAX];
  struct stat found;
  if (fstat(file, &found) == 0 && found.st_nlink > 0 &&
      (S_ISREG(found.st_mode) || S_ISDIR(found.st_mode)) &&
      path_of(file, path) && is_below(path)) {
    *inode = found.st_ino;
    watched = 1;
  }
  errno = saved;
  return watched;
}

/* Write the absolute path; return 1 if it is below the root. */
static int absolute(int directory, const char *name, char *path) {
  char base[PATH_MAX] = "";
  int saved = errno;
  if (name[0] != '/') {
    if (directory == AT_FDCWD) {
      if (getcwd(base, sizeof base) == NULL) base[0] = '\0';
    } else {
      path_of(directory, base);
    }
  }
  int length = snprintf(path, PATH_MAX, "%s%s%s", base, name[0] == '/' ? "" : "/", name);
  errno = saved;
  return length < PATH_MAX && is_below(path);
}

static void forced(int file) {
  uint64_t inode;
  if (is_watched(file, &inode)) record('F', 0, inode, 0, "", "", 0);
}

static void written(int file, const void *data, size_t size, uint64_t offset) {
  uint64_t inode;
  if (!is_watched(file, &inode)) return;
  record('W', 0, inode, offset, "", data, size);
  if (fcntl(file, F_GETFL) & O_DSYNC) forced(file);
}

/* Record what a call of the kernel wrote up to the position of a descriptor. */
static void copied(int file, ssize_t size) {
  uint64_t inode;
  char link[32];
  if (size <= 0 || !is_watched(file, &inode)) return;
  int saved = errno;
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  off_t end = lseek(file, 0, SEEK_CUR);
  char *data = malloc((size_t)size);
  REAL(open);
  int reader = real(link, O_RDONLY | O_CLOEXEC);
  if (data != NULL && reader >= 0 && pread(reader, data, (size_t)size, end - size) == size) {
    written(file, data, (size_t)size, (uint64_t)(end - size));
  } else {
    record('?', 0, inode, 0, "a copy could not be read", "", 0);
  }
  if (reader >= 0) close(reader);
  free(data);
  errno = saved;
}

static void resized(int file, off_t size) {
  uint64_t inode;
  if (is_watched(file, &inode)) record('T', 0, inode, (uint64_t)size, "", "", 0);
}

static void named(char kind, int directory, const char *name, uint64_t inode) {
  char path[PATH_MAX];
  if (absolute(directory, name, path)) record(kind, 0, inode, 0, path, "", 0);
}

static void paired(char kind, int flags, int from, const char *source, int to, const char *target) {
  char first[PATH_MAX], second[PATH_MAX];
  int is_from = absolute(from, source, first), is_to = absolute(to, target, second);
  if (is_from || is_to) record(kind, flags, 0, 0, first, second, strlen(second));
}

static int opened(int file, int directory, const char *name, int flags) {
  char path[PATH_MAX];
  struct stat found;
  if (file >= 0 && flags & (O_CREAT | O_TRUNC) && absolute(directory, name, path) &&
      fstat(file, &found) == 0 && S_ISREG(found.st_mode))
    record('O', (flags & O_TRUNC) != 0, found.st_ino, 0, path, "", 0);
  return file;
}

#define MODE(flags) \
  mode_t mode = 0; \
  if ((flags) & (O_CREAT | O_TMPFILE)) { \
    va_list more; \
    va_start(more, flags); \
    mode = va_arg(more, mode_t); \
    va_end(more); \
  }

/* The C library has each call a second time, for offsets of 64 bits. */
#define OPEN(function) \
  int function(const char *name, int flags, ...) { \
    MODE(flags) \
    REAL(function); \
    return opened(real(name, flags, mode), AT_FDCWD, name, flags); \
  }
OPEN(open)
OPEN(open64)

#define OPENAT(function) \
  int function(int directory, const char *name, int flags, ...) { \
    MODE(flags) \
    REAL(function); \
    return opened(real(directory, name, flags, mode), directory, name, flags); \
  }
OPENAT(openat)
OPENAT(openat64)

ssize_t write(int file, const void *data, size_t size) {
  REAL(write);
  ssize_t done = real(file, data, size);
  uint64_t inode;
  if (done > 0 && is_watched(file, &inode))
    written(file, data, (size_t)done, (uint64_t)(lseek(file, 0, SEEK_CUR) - done));
  return done;
}

ssize_t writev(int file, const struct iovec *parts, int count) {
  REAL(writev);
  ssize_t done = real(file, parts, count);
  copied(file, done);
  return done;
}

#define PWRITE(function, offset_type) \
  ssize_t function(int file, const void *data, size_t size, offset_type offset) { \
    REAL(function); \
    ssize_t done = real(file, data, size, offset); \
    if (done > 0) written(file, data, (size_t)done, (uint64_t)offset); \
    return done; \
  }
PWRITE(pwrite, off_t)
PWRITE(pwrite64, off64_t)

/* Record each part of a vector for itself, so a loss of power may also leave a part of it. */
static void scattered(int file, const struct iovec *parts, int count, ssize_t size, off64_t offset) {
  for (int at = 0; at < count && size > 0; at++) {
    size_t length = parts[at].iov_len < (size_t)size ? parts[at].iov_len : (size_t)size;
    if (length > 0) written(file, parts[at].iov_base, length, (uint64_t)offset);
    offset += (off64_t)length;
    size -= (ssize_t)length;
  }
}

#define PWRITEV(function, offset_type) \
  ssize_t function(int file, const struct iovec *parts, int count, offset_type offset) { \
    REAL(function); \
    ssize_t done = real(file, parts, count, offset); \
    scattered(file, parts, count, done, offset); \
    return done; \
  }
PWRITEV(pwritev, off_t)
PWRITEV(pwritev64, off64_t)

#define PWRITEV2(function, offset_type) \
  ssize_t function(int file, const struct iovec *parts, int count, offset_type offset, int flags) { \
    REAL(function); \
    ssize_t done = real(file, parts, count, offset, flags); \
    scattered(file, parts, count, done, offset); \
    return done; \
  }
PWRITEV2(pwritev2, off_t)
PWRITEV2(pwritev64v2, off64_t)

#define SENDFILE(function, offset_type) \
  ssize_t function(int to, int from, offset_type *offset, size_t count) { \
    REAL(function); \
    ssize_t done = real(to, from, offset, count); \
    copied(to, done); \
    return done; \
  }
SENDFILE(sendfile, off_t)
SENDFILE(sendfile64, off64_t)

ssize_t copy_file_range(int from, off64_t *in, int to, off64_t *out, size_t size, unsigned flags) {
  REAL(copy_file_range);
  ssize_t done = real(from, in, to, out, size, flags);
  copied(to, done);
  return done;
}

#define FTRUNCATE(function, size_type) \
  int function(int file, size_type size) { \
    REAL(function); \
    int done = real(file, size); \
    if (done == 0) resized(file, size); \
    return done; \
  }
FTRUNCATE(ftruncate, off_t)
FTRUNCATE(ftruncate64, off64_t)

int posix_fallocate64(int file, off64_t offset, off64_t size) {
  REAL(posix_fallocate64);
  struct stat before;
  int known = fstat(file, &before), done = real(file, offset, size);
  if (done == 0 && known == 0 && before.st_size < offset + size) resized(file, offset + size);
  return done;
}

#define SYNC(function) \
  int function(int file) { \
    REAL(function); \
    int done = real(file); \
    if (done == 0) forced(file); \
    return done; \
  }
SYNC(fsync)
SYNC(fdatasync)

int renameat(int from, const char *source, int to, const char *target) {
  REAL(renameat);
  int done = real(from, source, to, target);
  if (done == 0) paired('R', 0, from, source, to, target);
  return done;
}

int renameat2(int from, const char *source, int to, const char *target, unsigned flags) {
  REAL(renameat2);
  int done = real(from, source, to, target, flags);
  if (done == 0) paired('R', (int)flags, from, source, to, target);
  return done;
}

int rename(const char *source, const char *target) {
  REAL(rename);
  int done = real(source, target);
  if (done == 0) paired('R', 0, AT_FDCWD, source, AT_FDCWD, target);
  return done;
}

int linkat(int from, const char *source, int to, const char *target, int flags) {
  REAL(linkat);
  int done = real(from, source, to, target, flags);
  if (done == 0) paired('L', 0, from, source, to, target);
  return done;
}

int link(const char *source, const char *target) {
  REAL(link);
  int done = real(source, target);
  if (done == 0) paired('L', 0, AT_FDCWD, source, AT_FDCWD, target);
  return done;
}

int symlink(const char *content, const char *name) {
  REAL(symlink);
  int done = real(content, name);
  char path[PATH_MAX];
  if (done == 0 && absolute(AT_FDCWD, name, path))
    record('S', 0, 0, 0, path, content, strlen(content));
  return done;
}

int unlink(const char *name) {
  REAL(unlink);
  int done = real(name);
  if (done == 0) named('U', AT_FDCWD, name, 0);
  return done;
}

int unlinkat(int directory, const char *name, int flags) {
  REAL(unlinkat);
  int done = real(directory, name, flags);
  if (done == 0) named('U', directory, name, 0);
  return done;
}

int rmdir(const char *name) {
  REAL(rmdir);
  int done = real(name);
  if (done == 0) named('U', AT_FDCWD, name, 0);
  return done;
}

int mkdirat(int directory, const char *name, mode_t mode) {
  REAL(mkdirat);
  int done = real(directory, name, mode);
  struct stat found;
  if (done == 0 && fstatat(directory, name, &found, 0) == 0)
    named('M', directory, name, found.st_ino);
  return done;
}

int mkdir(const char *name, mode_t mode) {
  REAL(mkdir);
  int done = real(name, mode);
  struct stat found;
  if (done == 0 && stat(name, &found) == 0) named('M', AT_FDCWD, name, found.st_ino);
  return done;
}
