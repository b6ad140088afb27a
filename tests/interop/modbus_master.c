/* A Modbus master that nobody here wrote: libmodbus reads and writes a slave of ours.
 *
 *   modbus_master rtu DEVICE STATION
 *   modbus_master tcp PORT STATION
 *   modbus_master rtu|tcp DEVICE|PORT STATION READS
 *
 * Writes holding registers 100..163 (value 3 * n) and coils 16..36 (every other one on) and reads
 * them back, one register and one coil by functions 06 and 05 among them; then asks for what the
 * slave does not have (holding 9000). Exit code 0 when all is as it should be. With READS, reads
 * holding 100..163 so often instead, and prints microseconds per read: wall clock and CPU.
 */
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { WORDS = 64, FIRST = 100, BITS = 21, FIRST_BIT = 16, HOLE = 9000 };

static int fail(const char *what)
{
    fprintf(stderr, "%s: %s\n", what, modbus_strerror(errno));
    return 1;
}

static int converse(modbus_t *ctx)
{
    uint16_t out[WORDS], in[WORDS];
    uint8_t bits_out[BITS], bits_in[BITS];

    for (int i = 0; i < WORDS; i++)
        out[i] = (uint16_t) (3 * (FIRST + i));
    for (int i = 0; i < BITS; i++)
        bits_out[i] = i % 2 == 0;
    if (modbus_write_registers(ctx, FIRST, WORDS, out) != WORDS)
        return fail("write_registers");
    out[5] = 0xBEEF;
    if (modbus_write_register(ctx, FIRST + 5, 0xBEEF) != 1)
        return fail("write_register");
    if (modbus_read_registers(ctx, FIRST, WORDS, in) != WORDS || memcmp(in, out, sizeof in))
        return fail("read_registers");
    if (modbus_write_bits(ctx, FIRST_BIT, BITS, bits_out) != BITS)
        return fail("write_bits");
    bits_out[1] = 1;
    if (modbus_write_bit(ctx, FIRST_BIT + 1, 1) != 1)
        return fail("write_bit");
    if (modbus_read_bits(ctx, FIRST_BIT, BITS, bits_in) != BITS
        || memcmp(bits_in, bits_out, sizeof bits_in))
        return fail("read_bits");
    if (modbus_read_registers(ctx, HOLE, 1, in) != -1 || errno != EMBXILADD)
        return fail("read of a hole");
    return 0;
}

static double microseconds(clockid_t which)
{
    struct timespec now;
    clock_gettime(which, &now);
    return now.tv_sec * 1e6 + now.tv_nsec / 1e3;
}

static int measure(modbus_t *ctx, long reads)
{
    uint16_t in[WORDS];
    double wall = microseconds(CLOCK_MONOTONIC), cpu = microseconds(CLOCK_PROCESS_CPUTIME_ID);
    for (long i = 0; i < reads; i++)
        if (modbus_read_registers(ctx, FIRST, WORDS, in) != WORDS)
            return fail("read_registers");
    wall = microseconds(CLOCK_MONOTONIC) - wall;
    cpu = microseconds(CLOCK_PROCESS_CPUTIME_ID) - cpu;
    printf("%.1f %.1f\n", wall / reads, cpu / reads);
    return 0;
}

int main(int argc, char **argv)
{
    if (argc != 4 && argc != 5)
        return 2;
    modbus_t *ctx = strcmp(argv[1], "rtu") == 0
        ? modbus_new_rtu(argv[2], 19200, 'N', 8, 1)
        : modbus_new_tcp("127.0.0.1", atoi(argv[2]));
    if (ctx == NULL || modbus_set_slave(ctx, atoi(argv[3])) || modbus_connect(ctx))
        return fail("connect");
    modbus_set_response_timeout(ctx, 2, 0);
    int result = argc == 5 ? measure(ctx, atol(argv[4])) : converse(ctx);
    modbus_close(ctx);
    modbus_free(ctx);
    return result;
}
