/* A Modbus slave that nobody here wrote: libmodbus, on a serial port or on TCP.
 *
 *   modbus_slave rtu DEVICE STATION [changing]
 *   modbus_slave tcp PORT [changing]
 *
 * Coils and discrete inputs: every third is on. Holding register n holds n, input register n
 * holds 1000 + n. `changing`: after each answer every holding register is one more. Prints "ready"
 * when it listens.
 */
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

enum { COUNT = 10000 };

static modbus_mapping_t *memory(void)
{
    modbus_mapping_t *map = modbus_mapping_new(COUNT, COUNT, COUNT, COUNT);
    for (int i = 0; map != NULL && i < COUNT; i++) {
        map->tab_bits[i] = map->tab_input_bits[i] = i % 3 == 0;
        map->tab_registers[i] = (uint16_t) i;
        map->tab_input_registers[i] = (uint16_t) (1000 + i);
    }
    return map;
}

static int serve(modbus_t *ctx, modbus_mapping_t *map, int changing)
{
    uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
    for (;;) {
        int length = modbus_receive(ctx, query);
        if (length > 0) {
            modbus_reply(ctx, query, length, map);
            for (int i = 0; changing && i < COUNT; i++)
                map->tab_registers[i]++;
        }
        else if (length < 0 && (errno == ECONNRESET || errno == EBADF || errno == EIO))
            return errno;
    }
}

int main(int argc, char **argv)
{
    modbus_mapping_t *map = memory();
    if (map == NULL || argc < 3)
        return 2;
    if (strcmp(argv[1], "rtu") == 0 && argc >= 4) {
        modbus_t *ctx = modbus_new_rtu(argv[2], 19200, 'N', 8, 1);
        if (ctx == NULL || modbus_set_slave(ctx, atoi(argv[3])) || modbus_connect(ctx)) {
            fprintf(stderr, "%s\n", modbus_strerror(errno));
            return 1;
        }
        puts("ready");
        fflush(stdout);
        return serve(ctx, map, argc > 4);
    }
    if (strcmp(argv[1], "tcp") == 0) {
        modbus_t *ctx = modbus_new_tcp("127.0.0.1", atoi(argv[2]));
        int listener = ctx == NULL ? -1 : modbus_tcp_listen(ctx, 4);
        if (listener < 0) {
            fprintf(stderr, "%s\n", modbus_strerror(errno));
            return 1;
        }
        puts("ready");
        fflush(stdout);
        while (modbus_tcp_accept(ctx, &listener) >= 0) {
            serve(ctx, map, argc > 3);
            modbus_close(ctx);
        }
    }
    return 1;
}
