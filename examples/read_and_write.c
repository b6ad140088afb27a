// A consumer and writer in C, with zenoh-c, or with zenoh-pico and -DPICO. It needs cJSON.
//
//     cc read_and_write.c -lzenohc -lcjson -o read_and_write
//     ./read_and_write tcp/127.0.0.1:7447 plant mixer recipe 7
//
// It prints every good value of the tag; after five seconds it writes a value, if there is one, and
// ends: with 1 unless the device acknowledged the write. cJSON rounds integers beyond 2^53.
#include <cjson/cJSON.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#ifdef PICO
#include <zenoh-pico.h>
#define ENDPOINT "%s"
#define CONNECT(config, where) zp_config_insert(z_loan_mut(config), Z_CONFIG_CONNECT_KEY, where)
#else
#include <zenoh.h>
#define ENDPOINT "[\"%s\"]"
#define CONNECT(config, where) \
    zc_config_insert_json5(z_loan_mut(config), "connect/endpoints", where)
#endif

#define SILENT 15  // seconds: three documents of the device are missing
static volatile time_t heard;  // any message about the device

static cJSON *parsed(const z_loaned_bytes_t *payload) {
    z_owned_string_t text;
    z_bytes_to_string(payload, &text);
    cJSON *found = cJSON_ParseWithLength(z_string_data(z_loan(text)), z_string_len(z_loan(text)));
    z_drop(z_move(text));
    return found;
}

static bool is(const cJSON *document, const char *field, const char *word) {
    const char *found = cJSON_GetStringValue(cJSON_GetObjectItemCaseSensitive(document, field));
    return found != NULL && strcmp(found, word) == 0;
}

static void show(const char *what, const cJSON *document, const char *field) {
    char *text = cJSON_PrintUnformatted(cJSON_GetObjectItemCaseSensitive(document, field));
    printf("%s%s\n", what, text == NULL ? "no answer that this program knows" : text);
    fflush(stdout);
    cJSON_free(text);
}

static void on_value(z_loaned_sample_t *sample, void *context) {
    (void)context;
    cJSON *known = parsed(z_sample_payload(sample));
    if (!is(known, "quality", "good")) {
        show("not good: ", known, "reason");  // it has no value to use
    } else if (is(known, "origin", "simulated") || is(known, "origin", "replayed")) {
        show("not real: ", known, "value");
    } else {
        show("", known, "value");
    }
    cJSON_Delete(known);
}

static void on_token(z_loaned_sample_t *token, void *context) {
    (void)context;
    bool is_there = z_sample_kind(token) == Z_SAMPLE_KIND_PUT;  // else every value is unknown
    puts(is_there ? "the device is there" : "the device is gone: its last value is not good");
}

static void on_document(z_loaned_sample_t *sample, void *context) {
    (void)sample, (void)context;
    heard = time(NULL);
}

static void subscribe(const z_loaned_session_t *session, const char *key, bool is_token,
                      void (*call)(z_loaned_sample_t *, void *)) {
    z_view_keyexpr_t name;
    z_view_keyexpr_from_str(&name, key);
    z_owned_closure_sample_t closure;
    z_closure(&closure, call, NULL, NULL);
    z_liveliness_subscriber_options_t with_present = {.history = true};
    if (is_token)
        z_liveliness_declare_background_subscriber(session, z_loan(name), z_move(closure),
                                                   &with_present);
    else
        z_declare_background_subscriber(session, z_loan(name), z_move(closure), NULL);
}

static bool written(const z_loaned_session_t *session, const char *key, const char *value) {
    z_view_keyexpr_t name;
    z_view_keyexpr_from_str(&name, key);
    z_owned_bytes_t payload;
    z_bytes_copy_from_str(&payload, value);
    z_get_options_t options;
    z_get_options_default(&options);
    options.payload = z_move(payload);
    options.timeout_ms = 10000;
    z_owned_closure_reply_t closure;
    z_owned_fifo_handler_reply_t replies;
    z_fifo_channel_reply_new(&closure, &replies, 16);
    if (z_get(session, z_loan(name), "", z_move(closure), &options) != Z_OK) return false;
    bool is_done = false;
    z_owned_reply_t reply;
    while (!is_done && z_recv(z_loan(replies), &reply) == Z_OK) {
        is_done = z_reply_is_ok(z_loan(reply));
        cJSON *answer = parsed(is_done ? z_sample_payload(z_reply_ok(z_loan(reply)))
                                       : z_reply_err_payload(z_reply_err(z_loan(reply))));
        show(is_done ? "written: " : "not acknowledged: ", answer, is_done ? "value" : "error");
        cJSON_Delete(answer);
        z_drop(z_move(reply));
    }
    return is_done;  // false without an answer, or with `unclear`: it may be done. Do not repeat.
}

int main(int count, char **words) {
    char where[200], key[200], set[210], token[210], document[210];
    size_t length = 0;
    for (int i = 1; i < 5 && i < count; i++) length += strlen(words[i]);
    if (count < 5 || length > 150) return 2;  // a key that is cut off would be that of another tag
    snprintf(where, sizeof where, ENDPOINT, words[1]);
    snprintf(key, sizeof key, "%s/%s/%s", words[2], words[3], words[4]);
    snprintf(set, sizeof set, "%s/@set", key);
    snprintf(token, sizeof token, "%s/@gateway/*/alive/%s", words[2], words[3]);
    snprintf(document, sizeof document, "%s/@gateway/*/devices/%s", words[2], words[3]);

    z_owned_config_t config;
    z_config_default(&config);
    CONNECT(config, where);
    z_owned_session_t session;
    if (z_open(&session, z_move(config), NULL) < 0) return 2;
    heard = time(NULL);
    subscribe(z_loan(session), token, true, on_token);
    subscribe(z_loan(session), document, false, on_document);
    subscribe(z_loan(session), key, false, on_value);

    int code = 0;
    for (int second = 0; count == 5 || second < 5; second++) {
        z_sleep_s(1);
        if (time(NULL) - heard > SILENT) puts("nothing is heard: the last value is not good");
        fflush(stdout);
    }
    if (count > 5 && !written(z_loan(session), set, words[5])) {
        puts("the device did not acknowledge");
        code = 1;
    }
    fflush(stdout);
    _Exit(code);  // zenoh-pico 1.9 waits for ever for a link that has gone
}
