/* A system's clock that is off by what stands in a file, for the process that this library is preloaded into; the steady
   clock stays as it is. STEPPED_CLOCK names a file of 8 bytes, the offset in ns. Deadlines on the system's clock, which
   the kernel knows nothing of, are moved back, so that waits that begin after a step keep their length. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>

static const int64_t none = 0, *volatile offset_ns = &none;
static int (*next_gettime)(clockid_t, struct timespec *);
static int (*next_timedwait)(pthread_cond_t *, pthread_mutex_t *, const struct timespec *);
static int (*next_clockwait)(pthread_cond_t *, pthread_mutex_t *, clockid_t, const struct timespec *);
static int (*next_semaphore)(sem_t *, const struct timespec *);

__attribute__((constructor)) static void begin(void)
{
    const char *path = getenv("STEPPED_CLOCK");
    int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
    void *found = file < 0 ? MAP_FAILED : mmap(NULL, sizeof(int64_t), PROT_READ, MAP_SHARED, file, 0);
    next_gettime = dlsym(RTLD_NEXT, "clock_gettime");
    next_timedwait = dlvsym(RTLD_NEXT, "pthread_cond_timedwait", "GLIBC_2.3.2");
    next_clockwait = dlsym(RTLD_NEXT, "pthread_cond_clockwait");
    next_semaphore = dlsym(RTLD_NEXT, "sem_timedwait");
    if (found != MAP_FAILED)
        offset_ns = found;
}

static struct timespec moved(struct timespec time, int64_t by_ns)
{
    int64_t total = time.tv_sec * INT64_C(1000000000) + time.tv_nsec + by_ns;
    return (struct timespec){total / 1000000000, total % 1000000000};
}

/* The steady clock counts from the start of the machine. */
static struct timespec deadline(const struct timespec *time)
{
    return time->tv_sec > 1000000000 ? moved(*time, -*offset_ns) : *time;
}

int clock_gettime(clockid_t clock, struct timespec *time)
{
    if (!next_gettime)
        begin();
    int failed = next_gettime(clock, time);
    if (!failed && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE))
        *time = moved(*time, *offset_ns);
    return failed;
}

int gettimeofday(struct timeval *restrict time, void *restrict zone)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    *time = (struct timeval){now.tv_sec, now.tv_nsec / 1000};
    return 0;
}

time_t time(time_t *place)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (place)
        *place = now.tv_sec;
    return now.tv_sec;
}

int pthread_cond_timedwait(pthread_cond_t *restrict cond, pthread_mutex_t *restrict mutex, const struct timespec *restrict until)
{
    struct timespec when = deadline(until);
    return next_timedwait(cond, mutex, &when);
}

int pthread_cond_clockwait(pthread_cond_t *restrict cond, pthread_mutex_t *restrict mutex, clockid_t clock,
                           const struct timespec *restrict until)
{
    struct timespec when = deadline(until);
    return next_clockwait(cond, mutex, clock, &when);
}

int sem_timedwait(sem_t *restrict semaphore, const struct timespec *restrict until)
{
    struct timespec when = deadline(until);
    return next_semaphore(semaphore, &when);
}
