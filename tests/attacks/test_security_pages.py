"""Every sentence of the security pages: the tests that follow it to the letter and attack it.

`RULES` quotes each promise and names its tests. `NO_PROMISES` has the other sentences. So a new
sentence of a page needs a test, or a place among those that promise nothing.
"""

import re

import pytest

from tests.attacks.security_pages import PAGES, units
from tests.e2e.processes import ROOT

DEFAULT = "test_by_default_programs_of_this_machine_read_and_write_and_no_others"
WARNS = "test_a_gateway_that_others_reach_without_protection_warns"
MUTUAL = "test_with_mutual_true_every_client_needs_a_certificate_of_the_authority"
PASSWORDS = "test_by_name_and_password"
VARIABLE = "test_the_password_of_the_variable_and_the_warning_of_an_open_link"
FILES = "test_files_with_secrets_are_closed_and_hold_users_or_the_gateway_does_not_start"
UNSHOWN = "test_the_gateway_prints_and_serves_no_secret"
TYPED = "test_the_commands_of_the_page_write_with_the_files_that_the_person_may_read"
NO_OPTION = "test_no_option_takes_a_secret"
RIGHTS = "test_the_command_line_has_the_rights_of_its_user"
NO_USER = "test_without_a_user_the_command_line_names_the_variables_to_set"
OTHER_ADDRESS = "test_a_certificate_for_another_address_is_named_as_the_reason"
SIGNED = "test_only_writers_write_and_a_signature_counts_once_and_for_seconds"
COVERED = "test_a_signature_covers_key_value_time_nonce_and_name"
STOLEN = "test_a_program_that_receives_a_signed_write_can_do_nothing_with_it"
TAKEOVER = "test_a_gateway_that_becomes_active_accepts_no_signature_from_before"
POWER_CUT = "test_a_signed_write_counts_once_after_a_power_cut_and_a_clock_that_is_set_back"
SET_BACK = "test_a_clock_that_is_set_back_makes_no_signature_count_again"
AHEAD = "test_a_clock_of_the_gateway_that_was_a_day_ahead_locks_no_writer_out"
READERS = "test_a_flood_of_reads_denies_no_write"
PLACES = "test_each_kind_has_its_own_places"
FLOOD = "test_the_audit_trail_keeps_the_writes"
SHARED = "test_the_second_gateway_leaves_the_device_to_the_first"
CLAIMED = "test_forged_claims_are_refused_and_those_of_the_plant_count"
TOKEN = "test_a_forged_token_is_refused_and_the_gateway_goes_on"  # noqa: S105  (a test)
ONE_A_SECOND = "test_a_rate_limit_allows_a_burst_and_then_one_per_interval"
BEYOND = "test_no_client_gets_beyond_the_limits_or_delays_another_line"
HOSTILE = "test_a_flood_of_everything_costs_little_memory_and_no_poll"
USERS = "test_every_user_does_what_the_page_says_and_nothing_else"
WILDCARD = "test_with_allow_as_default_a_write_to_a_wildcard_arrives"
OWN_USER = "test_at_a_router_the_user_of_the_gateway_may_check_its_health_only"
SECOND = "test_behind_a_router_a_second_gateway_leaves_the_devices_to_the_first"

RULES: dict[str, dict[str, tuple[str, ...]]] = {
    "SECURITY.md": {
        "Without these settings the gateway listens on its own machine only, and every program on "
        "that machine can read and write.": (DEFAULT,),
        "These are vulnerabilities: a client reads or writes something that the configuration "
        "forbids;": (USERS, SIGNED, MUTUAL, PASSWORDS),
        "a message, a frame or a file ends the gateway or stops a line;": (
            BEYOND,
            HOSTILE,
            "test_any_received_bytes_give_words_or_a_gateway_error",
            "test_any_payload_is_a_value_or_is_refused",
            "test_any_file_gives_a_configuration_or_a_list_of_mistakes",
        ),
        "a secret appears in a log, a status document or a message.": (UNSHOWN, FILES),
        "Allow `write` only for tags that need it, and set `min` and `max`.": (DEFAULT,),
        "Allow `control: true` only where a remote RUN or STOP cannot hurt a person.": (DEFAULT,),
    },
    "docs/security.md": {
        "| [connection](#restrict-connections) | who can connect | `zenoh.tls`, `zenoh.users_file` "
        "|": (MUTUAL, PASSWORDS),
        "| [access control](access-control.md) | which keys a connected program can use | "
        "`zenoh.config_file` |": (USERS,),
        "| [writers](#name-the-writer) | which person or program can write | `writers` |": (
            SIGNED,
        ),
        "| [the tag](configuration.md#write) | whether it can be written, and its limits | `write` "
        "|": (DEFAULT,),
        # The default
        "The gateway listens on this machine only (`tcp/127.0.0.1:7447`), and every program on "
        "this machine can read and write.": (DEFAULT,),
        "If it listens elsewhere without protection, it warns at every start:": (WARNS, MUTUAL),
        # Restrict connections
        "By [certificate](enrol.md):": (MUTUAL,),
        "With `mutual: true` every client needs a certificate that `ca` has signed.": (MUTUAL,),
        "Without it, the certificate only proves the identity of the gateway, and every client may "
        "connect.": (MUTUAL,),
        "By name and password:": (PASSWORDS, VARIABLE),
        "On `tcp/` passwords are sent unencrypted; the gateway warns.": (VARIABLE,),
        "A wrong name, a wrong password and no password are refused in the same way.": (PASSWORDS,),
        "A `users_file` without a name is a mistake, because it would accept every connection. A "
        "line that is not `name:password` is a mistake too.": (FILES,),
        "The configuration file itself contains no password and no key. These files must be closed "
        "to other users of the machine (`chmod 640`, group of the service), or the gateway does "
        "not start: `key`, `password_file`, `users_file`, `writers.file`, `gateway.secret_file`, "
        "`web.tokens_file`, and a `config_file` that contains a password.": (
            FILES,
            PASSWORDS,
            "test_a_tokens_file_that_others_can_read_is_refused",
        ),
        "The gateway never shows their content in logs, status or messages,": (UNSHOWN, FILES),
        "and quotes nothing from a `config_file` that may contain a password.": (FILES,),
        # The web door
        "On loopback every program of this machine can read every value; it can write only with a "
        "token of `web.tokens_file`.": (
            "test_a_write_over_http_is_done_and_recorded_with_its_name",
            "test_a_write_needs_a_token_and_a_body_that_no_form_of_another_site_sends",
        ),
        "On another address each request for values or states needs a token, and the file is "
        "refused without `tokens_file`.": (
            "test_other_addresses_need_a_token_for_every_value",
            "test_an_address_for_other_machines_without_tokens_is_refused",
        ),
        "A token is a password: it is sent with each request, and HTTP does not encrypt it.": (
            "test_an_address_for_other_machines_is_warned_of",
        ),
        "Pages of other sites get nothing through the browser of an operator.": (
            "test_only_names_of_this_machine_are_answered",
            "test_pages_of_other_sites_get_nothing",
        ),
        # Use the command line with a secured gateway
        "`plc-gateway read`, `write`, `control`, `watch` and `health` take the address of the "
        "gateway and the certificates from the same file.": (RIGHTS, SIGNED),
        "Two variables name the user. They are not options, because the list of processes and the "
        "shell's history would show them:": (TYPED, NO_OPTION),
        "Without the variables these commands use `user` and the password of the file.": (
            TYPED,
            OWN_USER,
        ),
        "They reach a gateway that listens at `0.0.0.0` as `127.0.0.1`.": (RIGHTS, TYPED),
        "Its certificate must be valid for that address too: `subjectAltName = DNS:gateway.plant, "
        "IP:127.0.0.1`.": (OTHER_ADDRESS, PASSWORDS),
        "With `mutual: true` they use the gateway's own certificate. Rules with "
        "`cert_common_names` give them the rights of its name.": (MUTUAL,),
        "The person needs read access to the configuration file, `ca` and `config_file`; with "
        "`mutual: true` also to `certificate` and `key`; without the variables also to "
        "`password_file`.": (TYPED, MUTUAL),
        "They read neither `users_file` nor `writers.file`. An `access_control` in `config_file` "
        "restricts the gateway, not them.": (TYPED, RIGHTS),
        "`read` and `watch` need the rights of `viewer`, `write` those of `operator`, `health` "
        "those of `health`: to query the status and nothing else, which is enough for a "
        "container.": (RIGHTS,),
        "| `requires a name and password` | set the variables |": (NO_USER,),
        "| `takes connections and does not answer` | the gateway stands still: stopped, or without "
        "a processor |": ("test_a_gateway_that_stands_still_is_called_that",),
        "| `refuses the user operator` | the name or the password is wrong |": (RIGHTS,),
        "| `has an untrusted certificate` | `ca` has not signed it, or it is not valid for that "
        "address |": (OTHER_ADDRESS,),
        "| `no reply …, and may health query it?` | access control denies it, or no gateway serves "
        "these tags |": (RIGHTS,),
        # Name the writer
        "If several persons or programs may write, give each a secret: Make one with": (SIGNED,),
        "Put the line into `writers.txt`, which has a line `name:secret` for each writer, and give "
        "the same line to Alice.": (SIGNED,),
        "Her programs sign with it. They never send it: every program that is connected can "
        "receive a write.": (STOLEN,),
        "A signature covers the key, the value, a time and a random number.": (SIGNED, COVERED),
        "| a write without a valid signature | refused as `not-allowed` | allowed, if Zenoh allows "
        "it |": (SIGNED, DEFAULT),
        "| the same signature again | refused: `unclear`, because the first one may be done | |": (
            SIGNED,
        ),
        "| a signature older than 5 s, or 1 s ahead | refused as `not-allowed` | |": (SIGNED,),
        "| `by` in every outcome | the name of the writer | Zenoh's id of the sender, if known, "
        "which is rare |": (SIGNED, DEFAULT),
        "A gateway that starts or becomes active accepts no signature from before.": (
            SIGNED,
            TAKEOVER,
        ),
        "The file `writers.json`, in `$STATE_DIRECTORY` or beside the configuration, has the time "
        "until when signatures were accepted, and 6 s more: none of them counts again, also with a "
        "clock that was set back while the gateway did not run.": (POWER_CUT, SET_BACK),
        "A clock that was ahead for less than an hour locks no writer out. If the log says `is a "
        "clock wrong?`, correct the clock; if the file has a time in the future, stop the gateway "
        "and delete the file.": (AHEAD, POWER_CUT),
        "`plc-gateway write` and `control` sign with the variable `PLC_GATEWAY_WRITER`, which "
        "holds the line. [write-values.md](write-values.md#sign-a-write) shows how a program "
        "signs.": (STOLEN, SIGNED),
        "The file is read again within a second of a change. To withdraw a secret, delete its "
        "line. If the file becomes unreadable, or its disk does not answer for ten seconds, "
        "every write is refused.": (SIGNED,),
        "Then the gateway warns at every start, and `check` warns too.": (STOLEN,),
        # Records of writes
        "Every outcome of a write or command is logged, published on "
        "`plant/@gateway/demo/writes` and kept in history: time, key, value, outcome, duration, "
        "and by whom.": (SIGNED,),
        "So that they fill no disk, 300 are recorded one by one, then one a second.": (
            FLOOD,
            ONE_A_SECOND,
        ),
        'The others are counted: the record `{"outcome": "suppressed", "count": 30, "kinds": '
        '{"unknown-tag": 30}}` has their number, also the log and, as `refusals_untold`, the '
        "status.": (FLOOD,),
        "History keeps refusals apart, so they never push out the record of a write that was "
        "sent.": (FLOOD,),
        "Writes that found no free place are counted there as `puts_refused` and `refused`.": (
            BEYOND,
        ),
        # Several gateways
        "Gateways under one prefix [share out their "
        "devices](zenoh.md#the-same-device-in-two-files) by claims.": (SHARED,),
        "A secret that all gateways of the plant have prevents this:": (CLAIMED,),
        "The first line of the file has 20 characters or more.": (FILES,),
        "A claim without its signature takes no device off. The log names it (`claim refused`), "
        "and `refused_claims` in the status.": (CLAIMED,),
        "The secret also signs the tokens of a [standby group](standby.md).": (TOKEN,),
        # Limits
        "| message | 256 kB | dropped by Zenoh before it is put together |": (BEYOND,),
        "| payload of a write | a JSON value of 64 kB | refused |": (BEYOND,),
        "| open reads | 1,024 | `busy`, or no answer if even that cannot be sent |": (BEYOND,),
        "| of these with a wildcard | 64 | `busy` |": (BEYOND,),
        "| `@peek` that wait for one line | 16 | `busy` |": (PLACES,),
        "| open writes, commands and acknowledgements | 1,024, beside the reads | `busy` |": (
            BEYOND,
            READERS,
        ),
        "| of these writes | 256 | `busy` |": (BEYOND,),
        "A router drops messages above Zenoh's own limit instead, because it also forwards other "
        "messages.": (TAKEOVER,),
        "No load from clients delays the lines: Zenoh's threads only append to queues of 1,024.": (
            BEYOND,
            HOSTILE,
        ),
        "Reads, however many, take no place of a write. A peek waits until no write or command "
        "waits.": (READERS, PLACES),
    },
    "docs/access-control.md": {
        "Zenoh's access control works by key and by user name, or by the common name of a "
        "certificate. It belongs to the process that clients connect to: a router, or the gateway "
        "itself.": (USERS, MUTUAL),
        "`default_permission` must be `deny`. With `allow` and a rule against `plant/**/@set`, a "
        "write to `**/@set` would still arrive, because a rule applies only to keys that are "
        "completely within its own.": (WILDCARD,),
        "| `viewer` | read everything |": (USERS,),
        "| `operator` | read, write, acknowledge alarms |": (USERS,),
        "| `health` | query the status, for `plc-gateway health` |": (USERS, RIGHTS),
        "| `gateway` | on a router: publish and answer as a gateway |": (USERS, SECOND, TAKEOVER),
        "Denied messages are dropped without an answer: a `get` returns nothing, a `put` seems to "
        "succeed. With these rules a `get` on `**` returns nothing either. Use `plant/**`.": (
            USERS,
        ),
        "Set `zenoh.config_file: access.json5` beside `users_file`:": (USERS,),
        "The same rules for clients, and the rules for gateways. Here `plc-gateway health` also "
        "works with the gateway's own `user`.": (USERS, SECOND, OWN_USER),
        "**Commands.** These rules let no client send a command (`@run`, `@stop` and others of "
        "devices with `control: true`). Give a person who may send commands a subject with these "
        "rules:": (USERS,),
        "`ask`, `tell`, `watch` and `alive`;": (USERS,),
        "a rule like `write` for `plant/*/@run`, `plant/*/@stop`, `plant/*/@loopback` and "
        "`plant/*/@model`;": (USERS,),
        "a rule like `outcome` for the same keys.": (USERS,),
        "This subject does not have the rule `command-none`. So it may also command all stations "
        "of a line.": (USERS,),
        # Each order about an alarm is a payload of a query on its key: one rule is for all.
        "**Alarms.** A user who may read may also acknowledge and shelve alarms, and take them out "
        "of service, unless the user has the rule `acknowledge-none`. Such a user reads alarms "
        "with a `get` on `plant/@gateway/*/alarms/**`.": (USERS,),
        "**Self-description.** No wildcard matches `plant/@gateway/*/@describe` and "
        "`plant/@gateway/*/@introspect`. To let clients read [them](contract.md), add both keys to "
        "the rules `ask` and `tell`, at a router also to `offer` and `asked`.": (USERS,),
        "**One device only.** To let a user write one device only, use `plant/mixer/**/@set` "
        "instead of `plant/**/@set` in a rule of its own like `write`. The rule `outcome` stays as "
        "it is: the gateway declares the whole key.": (USERS,),
        "**Some tags only.** `plant/mixer/@set` writes [any tags of the device](write-groups.md), "
        "and `plant/mixer/**/@set` matches it. To let a user write some tags only, allow their "
        "keys one by one (`plant/mixer/recipe/@set`).": (USERS,),
    },
}

# Explanations, advice to people, and what only other programs can do.
NO_PROMISES: dict[str, tuple[str, ...]] = {
    "SECURITY.md": (
        (
            "[docs/security.md](docs/security.md) explains what can be configured: TLS, "
            "users, access control, signatures of writers."
        ),
        (
            "The serial protocols have no authentication. A person who can reach the wire "
            "or the port of a device server can control the PLCs. The gateway cannot "
            "prevent this: keep device servers in a network of their own."
        ),
        (
            "This program writes to machines. A write or a command can start a drive or "
            "open a valve."
        ),
        (
            "Do not use the gateway for an emergency stop or another safety function. It is"
            " not a safety device, and the network, Zenoh and the serial line add delays "
            "without an upper limit."
        ),
        "Keep the interlocks in the PLC and in the wiring.",
    ),
    "docs/security.md": (
        (
            "If the file is damaged, this protection is lost for the present start, which is a "
            "[fault](status.md#damaged)."
        ),
        (
            "One attack has no limit here: two key expressions with some 15 `**` each, of any "
            "client that is connected, stop Zenoh 1.10.2 "
            "([attacks](contributors/attacks.md#not-withstood)). "
            "Only the [connection](#restrict-connections) protects against it."
        ),
        (
            "How to decide who can connect, read and write. There are four levels, from the"
            " outside in:"
        ),
        (
            "With `web` in the file the gateway answers HTTP too: "
            "[page.md](page.md#who-may-use-it) has the rules."
        ),
        (
            "Rules of `access_control` and `writers` are Zenoh's: they do not count here, so a "
            "token is good for every tag that has `write`."
        ),
        ("Zenoh does not tell the gateway who sent a query, only which process forwarded it."),
        "So the clocks of both machines must agree (NTP).",
        (
            "A signature proves who wrote. It does not prove who answers: without [access "
            "control](access-control.md) any connected program can answer a write in place "
            "of the gateway, and publish values."
        ),
        (
            "Every gateway under the prefix receives the value. Use `tls/`, because values "
            "can be read on an unencrypted connection."
        ),
        (
            "Writes that are refused before anything is sent (`not-allowed`, `unknown-tag`,"
            " `bad-value` and others) can arrive very fast."
        ),
        (
            "Without access control any connected program can claim too: it takes devices "
            "off a gateway, or ends it in its own name."
        ),
        (
            "Give the file to all gateways while they are stopped: one with the secret "
            "ignores one without it, and both would serve the same device."
        ),
        (
            "A program that saw a signed claim can repeat it after its gateway has ended. "
            "Only access control prevents this."
        ),
    ),
    "docs/access-control.md": (
        (
            "How to decide, for each user, which keys a connected program may read and "
            "write. Set up [TLS and users](security.md#restrict-connections) first."
        ),
    ),
}
_OUTSIDE = {"Reporting a vulnerability", "Supported versions"}  # sections about the project


def one_line(page: str) -> str:
    return " ".join(unit.text for unit in units(PAGES[page]) if unit.section not in _OUTSIDE)


@pytest.mark.parametrize("page", PAGES)
def test_every_sentence_of_the_page_is_quoted_once(page: str) -> None:
    left = one_line(page)
    for quote in (*RULES[page], *NO_PROMISES[page]):
        assert left.count(quote) == 1, f"{page} does not say once: {quote}"
        left = left.replace(quote, "")
    assert left.split() == [], f"{page}: neither a test nor known as no promise: {left.strip()}"


def test_every_rule_has_tests_that_exist() -> None:
    known = [
        name
        for file in (ROOT / "tests").rglob("test_*.py")
        for name in re.findall(r"^(?:async )?def (test_\w+)", file.read_text("utf-8"), re.MULTILINE)
    ]
    for rules in RULES.values():
        for quote, tests in rules.items():
            assert tests, quote
            for test in tests:
                assert known.count(test) == 1, f"{test} of: {quote}"


def test_every_program_of_the_pages_is_run() -> None:
    """The settings, commands and rules are read out of the page by the tests."""
    used = {
        "docs/security.md": ["text", "yaml", "yaml", "console", "yaml", "console", "yaml"],
        "docs/access-control.md": ["json5", "json5"],
        "SECURITY.md": [],
    }
    for page, text in PAGES.items():
        assert re.findall(r"^```(\w+)$", text, re.MULTILINE) == used[page]
