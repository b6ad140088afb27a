/* The Modbus slaves of benchmarks/scenarios.py: a TCP port for each line, on loopback.
 *
 *   scenario_slave FIRST_PORT LINES UNITS TAGS TYPE CHANGING BAUD RECORD
 *
 * Each line has UNITS slaves of TAGS numbers in the holding registers from 0, two registers each,
 * the high word first. TYPE `uint32`: a number has the place of its register and, where CHANGING is
 * 1, the milliseconds of the monotonic clock when the reply is sent; the time is mixed into the high
 * word, so that halves of two replies do not fit. TYPE `float32`: the same with fewer bits, as a
 * multiple of 1/64. BAUD 0: Modbus TCP; otherwise RTU over TCP, and each reply takes the time of the
 * wire at that speed. Registers from 60000 can be written.
 *
 * The file RECORD gets, for each read, the place of the first number, their count and the time. At
 * the end of standard input the program prints the number and the sum of all written values.
 */
#include <arpa/inet.h>
#include <netinet/tcp.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { WRITABLE = 60000, EXTRA = 100, TURNAROUND = 2000 /* us */, CHARACTER = 11 /* bits */ };

typedef struct {
    int socket, line, have, pending;
    uint64_t due; /* us; of the reply in `out` */
    uint8_t in[1024], out[300];
} Connection;

static int lines, units, tags, changing, baud, is_float;
static uint16_t *written;
static unsigned long writes, sum;
static FILE *record;

static uint64_t now(void) /* us */
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (uint64_t) t.tv_sec * 1000000 + t.tv_nsec / 1000;
}

static uint16_t *writable(int line, int unit, int address)
{
    return &written[((line * (units + 1)) + unit) * EXTRA + address - WRITABLE];
}

static uint32_t number(uint32_t place, uint32_t ms)
{
    if (is_float) {
        float value = (float) ((place * 2654435761u >> 22 << 14) | ms) / 64.0f;
        uint32_t bits;
        memcpy(&bits, &value, 4);
        return bits;
    }
    uint32_t plain = place << 14 | ms;
    return plain ^ (ms * 40503u & 0xFFFF) << 16;
}

static uint16_t crc(const uint8_t *data, int length)
{
    uint16_t value = 0xFFFF;
    for (int i = 0; i < length; i++) {
        value ^= data[i];
        for (int bit = 0; bit < 8; bit++)
            value = value & 1 ? value >> 1 ^ 0xA001 : value >> 1;
    }
    return value;
}

/* Returns the length of the reply to a request: unit, function, address, count or value. */
static int answer(int line, const uint8_t *ask, uint8_t *out, uint64_t at)
{
    int unit = ask[0], address = ask[2] << 8 | ask[3], count = ask[4] << 8 | ask[5];
    uint32_t ms = changing ? at / 1000 & 0x3FFF : 0;
    out[0] = unit, out[1] = ask[1];
    if (unit < 1 || unit > units)
        return out[1] |= 0x80, out[2] = 11, 3;
    if (ask[1] == 6 && address >= WRITABLE && address < WRITABLE + EXTRA) {
        *writable(line, unit, address) = count, writes++, sum += count;
        memcpy(out, ask, 6);
        return 6;
    }
    if (ask[1] != 3)
        return out[1] |= 0x80, out[2] = 1, 3;
    if (count < 1 || count > 125)
        return out[1] |= 0x80, out[2] = 3, 3;
    out[2] = 2 * count;
    if (address >= WRITABLE && address + count <= WRITABLE + EXTRA) {
        for (int i = 0; i < count; i++) {
            uint16_t word = *writable(line, unit, address + i);
            out[3 + 2 * i] = word >> 8, out[4 + 2 * i] = word;
        }
        return 3 + 2 * count;
    }
    if (address % 2 || count % 2 || address + count > 2 * tags)
        return out[1] |= 0x80, out[2] = 2, 3;
    uint32_t first = ((uint32_t) line * units + unit - 1) * tags + address / 2;
    for (int i = 0; i < count / 2; i++) {
        uint32_t word = htonl(number(first + i, ms));
        memcpy(out + 3 + 4 * i, &word, 4);
    }
    uint32_t numbers = count / 2;
    fwrite(&first, 4, 1, record), fwrite(&numbers, 4, 1, record), fwrite(&at, 8, 1, record);
    return 3 + 2 * count;
}

static void send_out(Connection *c)
{
    if (c->pending && write(c->socket, c->out, c->pending) != c->pending)
        perror("write");
    c->pending = 0;
}

/* Takes the whole requests that arrived. A paced reply waits for its time. */
static void take(Connection *c)
{
    if (!baud) {
        while (c->have >= 12) {
            int length = answer(c->line, c->in + 6, c->out + 6, now());
            memcpy(c->out, c->in, 4), c->out[4] = length >> 8, c->out[5] = length;
            c->pending = 6 + length;
            send_out(c);
            memmove(c->in, c->in + 12, c->have -= 12);
        }
    }
    else if (c->have >= 8 && !c->pending) {
        /* The values are those of the moment when the station begins its reply. */
        uint64_t begins = now() + TURNAROUND + 8ull * CHARACTER * 1000000 / baud;
        int length = answer(c->line, c->in, c->out, begins);
        uint16_t check = crc(c->out, length);
        c->out[length] = check, c->out[length + 1] = check >> 8;
        c->pending = length + 2;
        c->due = begins + (uint64_t) c->pending * CHARACTER * 1000000 / baud;
        memmove(c->in, c->in + 8, c->have -= 8);
    }
}

static int listener(int port)
{
    int on = 1, fd = socket(AF_INET, SOCK_STREAM, 0);
    struct sockaddr_in where = {.sin_family = AF_INET, .sin_port = htons(port)};
    where.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    setsockopt(fd, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on);
    if (bind(fd, (struct sockaddr *) &where, sizeof where) || listen(fd, 8)) {
        perror("listen");
        exit(1);
    }
    return fd;
}

int main(int argc, char **argv)
{
    if (argc != 9)
        return 2;
    lines = atoi(argv[2]), units = atoi(argv[3]), tags = atoi(argv[4]);
    is_float = !strcmp(argv[5], "float32"), changing = atoi(argv[6]), baud = atoi(argv[7]);
    written = calloc((size_t) lines * (units + 1) * EXTRA, sizeof *written);
    Connection *all = calloc(2 * lines + 8, sizeof *all);
    record = fopen(argv[8], "wb");
    if (!written || !all || !record)
        return 1;
    int queue = epoll_create1(0), used = 0;
    struct epoll_event event = {.events = EPOLLIN, .data.u64 = 1u << 30};
    epoll_ctl(queue, EPOLL_CTL_ADD, 0, &event);
    for (int i = 0; i < lines; i++) {
        int fd = listener(atoi(argv[1]) + i);
        event.data.u64 = (uint64_t) fd << 32 | 1u << 29 | i;
        epoll_ctl(queue, EPOLL_CTL_ADD, fd, &event);
    }
    puts("ready");
    fflush(stdout);
    for (;;) {
        int wait = -1;
        uint64_t at = now();
        for (int i = 0; baud && i < used; i++)
            if (all[i].pending) {
                if (all[i].due <= at)
                    send_out(&all[i]), take(&all[i]);
                if (all[i].pending) {
                    int left = all[i].due > at ? (all[i].due - at + 999) / 1000 : 0;
                    wait = wait < 0 || left < wait ? left : wait;
                }
            }
        struct epoll_event found[64];
        int count = epoll_wait(queue, found, 64, wait);
        for (int i = 0; i < count; i++) {
            uint64_t data = found[i].data.u64;
            uint32_t low = data;
            if (low & 1u << 30) { /* standard input */
                char text[64];
                if (read(0, text, sizeof text) <= 0) {
                    fclose(record);
                    printf("%lu %lu\n", writes, sum);
                    return 0;
                }
            }
            else if (low & 1u << 29) {
                int on = 1, place = 0;
                while (place < used && all[place].socket)
                    place++;
                if (place >= 2 * lines + 6)
                    continue;
                all[place] = (Connection) {.line = low & 0xFFFF};
                all[place].socket = accept(data >> 32, NULL, NULL);
                setsockopt(all[place].socket, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
                used = place == used ? used + 1 : used;
                event.data.u64 = place;
                epoll_ctl(queue, EPOLL_CTL_ADD, all[place].socket, &event);
            }
            else {
                Connection *c = &all[low];
                int length = read(c->socket, c->in + c->have, sizeof c->in - c->have);
                if (length > 0)
                    c->have += length, take(c);
                else {
                    close(c->socket);
                    *c = (Connection) {0};
                }
            }
        }
    }
}
