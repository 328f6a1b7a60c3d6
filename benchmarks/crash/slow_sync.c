/* A disk whose syncs take SYNC_DELAY_MS milliseconds longer, for `LD_PRELOAD`.
 *
 * SYNC_BELOW, if set, is the directory with the files and directories of this disk. SYNC_LOG, if
 * set, is a file that gets a line for each sync: pid, thread id and path.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <time.h>
#include <unistd.h>

static void note(const char *path) {
  const char *log = getenv("SYNC_LOG");
  int file = log == NULL ? -1 : open(log, O_WRONLY | O_APPEND | O_CREAT | O_CLOEXEC, 0600);
  if (file < 0) return;
  dprintf(file, "%d %ld %s\n", (int)getpid(), syscall(SYS_gettid), path);
  close(file);
}

static void delay(int file) {
  const char *text = getenv("SYNC_DELAY_MS"), *below = getenv("SYNC_BELOW");
  char link[32], path[PATH_MAX];
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t length = readlink(link, path, sizeof path - 1);
  path[length < 0 ? 0 : length] = '\0';
  if (below != NULL && strncmp(path, below, strlen(below)) != 0) return;
  note(path);
  long ms = text == NULL ? 0 : atol(text);
  struct timespec pause = {ms / 1000, ms % 1000 * 1000000};
  nanosleep(&pause, NULL);
}

int fsync(int file) {
  static int (*real)(int);
  if (real == NULL) real = (int (*)(int))dlsym(RTLD_NEXT, "fsync");
  delay(file);
  return real(file);
}

int fdatasync(int file) {
  static int (*real)(int);
  if (real == NULL) real = (int (*)(int))dlsym(RTLD_NEXT, "fdatasync");
  delay(file);
  return real(file);
}
