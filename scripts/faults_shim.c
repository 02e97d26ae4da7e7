// Lets the n-th file operation below a folder fail, or end the process there with half of a write done.
// Preloaded (LD_PRELOAD) by scripts/faults.py, which has the modes; Linux and glibc.
// It does nothing until `shim_arm` names a folder.
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/sendfile.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

enum { COUNT, KILL, FULL, BROKEN, READ_ONLY };

static char folder[PATH_MAX];
static size_t folder_length;
static long at;
static int mode;
static long count;                                         // operations since the folder was named
static pthread_mutex_t one = PTHREAD_MUTEX_INITIALIZER;    // a process ends within one operation, not two

void shim_arm(const char *path, long operation, int how) {
  pthread_mutex_lock(&one);
  folder_length = strlen(path);
  if (folder_length >= sizeof folder) folder_length = 0;
  memcpy(folder, path, folder_length);
  folder[folder_length] = 0;
  at = operation, mode = how, count = 0;
  pthread_mutex_unlock(&one);
}

long shim_count(void) { return count; }

static void renew(void) { pthread_mutex_init(&one, NULL); }  // another thread may hold it in a fork

__attribute__((constructor)) static void begin(void) { pthread_atfork(NULL, NULL, renew); }

static int below(const char *path) {
  return folder_length && path && !strncmp(path, folder, folder_length) &&
         (path[folder_length] == '/' || !path[folder_length]);
}

static int named(int directory, const char *path) {
  char whole[2 * PATH_MAX], link[64];
  if (!folder_length || !path) return 0;
  if (path[0] == '/') return below(path);
  if (directory == AT_FDCWD) {
    if (!getcwd(whole, PATH_MAX)) return 0;
  } else {
    snprintf(link, sizeof link, "/proc/self/fd/%d", directory);
    ssize_t n = readlink(link, whole, PATH_MAX - 1);
    if (n < 0) return 0;
    whole[n] = 0;
  }
  strncat(whole, "/", 2);
  strncat(whole, path, PATH_MAX - 1);
  return below(whole);
}

static int opened(int file) {
  char path[PATH_MAX], link[64];
  if (!folder_length) return 0;
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  ssize_t n = readlink(link, path, sizeof path - 1);
  if (n < 0) return 0;
  path[n] = 0;
  return below(path);
}

// Counts an operation.  Returns 0 to let it happen, 1 to do half of it and end, -1 to fail with errno.
static int fault(int ours, int frees) {
  if (!ours) return 0;
  pthread_mutex_lock(&one);
  long n = ++count;
  int found = 0;
  if (mode == KILL && n == at) return 1;  // nobody goes on: the lock stays
  if (mode == FULL && n >= at && !frees) found = -1, errno = ENOSPC;
  if (mode == READ_ONLY && n >= at) found = -1, errno = EROFS;
  if (mode == BROKEN && n == at) found = -1, errno = EIO;
  int why = errno;
  pthread_mutex_unlock(&one);
  errno = why;
  return found;
}

static void end(void) {
  kill(getpid(), SIGKILL);
  for (;;) pause();
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define WRITES(type, name, declared, passed, halved)       \
  type name declared {                                     \
    static __typeof__(&name) real;                         \
    if (!real) real = REAL(name);                          \
    int what = fault(opened(file), 0);                     \
    if (what < 0) return -1;                               \
    if (what) {                                            \
      real halved;                                         \
      end();                                               \
    }                                                      \
    return real passed;                                    \
  }
#define ACTS(name, ours, frees, declared, passed)          \
  int name declared {                                      \
    static __typeof__(&name) real;                         \
    if (!real) real = REAL(name);                          \
    int what = fault(ours, frees);                         \
    if (what < 0) return -1;                               \
    if (what) end();                                       \
    return real passed;                                    \
  }

WRITES(ssize_t, write, (int file, const void *data, size_t n), (file, data, n), (file, data, n / 2))
WRITES(ssize_t, pwrite, (int file, const void *data, size_t n, off_t to), (file, data, n, to), (file, data, n / 2, to))
WRITES(ssize_t, pwrite64, (int file, const void *data, size_t n, off64_t to), (file, data, n, to), (file, data, n / 2, to))
WRITES(ssize_t, writev, (int file, const struct iovec *parts, int n), (file, parts, n), (file, parts, n / 2))
WRITES(ssize_t, pwritev, (int file, const struct iovec *parts, int n, off_t to), (file, parts, n, to), (file, parts, n / 2, to))
WRITES(ssize_t, pwritev64, (int file, const struct iovec *parts, int n, off64_t to), (file, parts, n, to), (file, parts, n / 2, to))
WRITES(ssize_t, sendfile, (int file, int from, off_t *at, size_t n), (file, from, at, n), (file, from, at, n / 2))
WRITES(ssize_t, sendfile64, (int file, int from, off64_t *at, size_t n), (file, from, at, n), (file, from, at, n / 2))
WRITES(ssize_t, copy_file_range, (int from, off64_t *a, int file, off64_t *b, size_t n, unsigned how),
       (from, a, file, b, n, how), (from, a, file, b, n / 2, how))
ACTS(ftruncate, opened(file), 0, (int file, off_t n), (file, n))
ACTS(ftruncate64, opened(file), 0, (int file, off64_t n), (file, n))
ACTS(fsync, opened(file), 0, (int file), (file))
ACTS(fdatasync, opened(file), 0, (int file), (file))
ACTS(rename, named(AT_FDCWD, to), 0, (const char *from, const char *to), (from, to))
ACTS(renameat, named(b, to), 0, (int a, const char *from, int b, const char *to), (a, from, b, to))
ACTS(renameat2, named(b, to), 0, (int a, const char *from, int b, const char *to, unsigned how), (a, from, b, to, how))
ACTS(link, named(AT_FDCWD, to), 0, (const char *from, const char *to), (from, to))
ACTS(mkdir, named(AT_FDCWD, path), 0, (const char *path, mode_t bits), (path, bits))
ACTS(mkdirat, named(directory, path), 0, (int directory, const char *path, mode_t bits), (directory, path, bits))
ACTS(unlink, named(AT_FDCWD, path), 1, (const char *path), (path))
ACTS(unlinkat, named(directory, path), 1, (int directory, const char *path, int how), (directory, path, how))
ACTS(rmdir, named(AT_FDCWD, path), 1, (const char *path), (path))

// Reading is no file operation here.
static int makes(int flags) { return (flags & (O_CREAT | O_TRUNC)) != 0 || (flags & O_TMPFILE) == O_TMPFILE; }

#define OPENS(name, ours, declared, passed)                \
  int name declared {                                      \
    static __typeof__(&name) real;                         \
    if (!real) real = REAL(name);                          \
    va_list rest;                                          \
    va_start(rest, flags);                                 \
    mode_t bits = makes(flags) ? va_arg(rest, mode_t) : 0; \
    va_end(rest);                                          \
    int what = makes(flags) ? fault(ours, 0) : 0;          \
    if (what < 0) return -1;                               \
    if (what) end();                                       \
    return real passed;                                    \
  }
OPENS(open, named(AT_FDCWD, path), (const char *path, int flags, ...), (path, flags, bits))
OPENS(open64, named(AT_FDCWD, path), (const char *path, int flags, ...), (path, flags, bits))
OPENS(openat, named(directory, path), (int directory, const char *path, int flags, ...), (directory, path, flags, bits))
OPENS(openat64, named(directory, path), (int directory, const char *path, int flags, ...), (directory, path, flags, bits))
