"""Tables of the manuals, copied: what the shipped templates must have."""

# Vigor communication manual, B-3-4 CPU Link Related Components
CPU_LINK = {
    "M9183": "failed master",
    "M9184": "failed slave 1",
    "M9185": "failed slave 2",
    "M9186": "failed slave 3",
    "M9187": "failed slave 4",
    "M9188": "failed slave 5",
    "M9189": "failed slave 6",
    "M9190": "failed slave 7",
    "D9172": "time-out time",
    "D9177": "number of network slave stations",
    "D9178": "range of send component",
    "D9179": "communication retry",
    "D9201": "current network scan time",
    "D9202": "max network scan time",
    "D9203": "errors master",
    "D9204": "errors slave 1",
    "D9205": "errors slave 2",
    "D9206": "errors slave 3",
    "D9207": "errors slave 4",
    "D9208": "errors slave 5",
    "D9209": "errors slave 6",
    "D9210": "errors slave 7",
    "D9212": "error code slave 1",
    "D9213": "error code slave 2",
    "D9214": "error code slave 3",
    "D9215": "error code slave 4",
    "D9216": "error code slave 5",
    "D9217": "error code slave 6",
    "D9218": "error code slave 7",
}
# B-3-4, Communication Error Code of CPU Link (value of D9212 to D9218)
CPU_LINK_CODES = {0x00: "no error", 0x01: "time-out", 0x05: "check sum"}
# B-3-4, data of the stations 0 (master) to 7. Mode 3, station 4 is printed as M1256 to M1391: the
# ranges beside it and the 64 relays of each station make it M1256 to M1319.
CPU_LINK_DATA = {
    1: [
        *("D0-3", "D10-13", "D20-23", "D30-33"),
        *("D40-43", "D50-53", "D60-63", "D70-73"),
    ],
    2: [
        *("D0-3 M1000-1031", "D10-13 M1064-1095", "D20-23 M1128-1159", "D30-33 M1192-1223"),
        *("D40-43 M1256-1287", "D50-53 M1320-1351", "D60-63 M1384-1415", "D70-73 M1448-1479"),
    ],
    3: [
        *("D0-7 M1000-1063", "D10-17 M1064-1127", "D20-27 M1128-1191", "D30-37 M1192-1255"),
        *("D40-47 M1256-1319", "D50-57 M1320-1383", "D60-67 M1384-1447", "D70-77 M1448-1511"),
    ],
}
# B-3-5 Parallel Link Related Components
PARALLEL_LINK = {
    "M9063": "error",
    "M9070": "is the master",
    "M9071": "is the slave",
    "M9072": "normal",
    "M9162": "high speed",
}
# B-3-5, data range: master to slave, slave to master
PARALLEL_LINK_DATA = {
    "normal": ("M800-899 D490-499", "M900-999 D500-509"),
    "high-speed": ("D490-491", "D500-501"),
}
# FNC 80, RS Instruction Related Components
RS = {
    "M9063": "error",
    "M9122": "send flag",
    "M9123": "receive done",
    "M9124": "cd signal",
    "M9129": "time-out",
    "M9161": "8-bit mode",
    "D9063": "communication error",
    "D9122": "left",
    "D9123": "received",
    "D9124": "start",
    "D9125": "end",
    "D9129": "time-out",
}
# B-3-8 MODEM Dialing Function
MODEM = {
    "M9100": "start",
    "M9101": "failed",
    "M9124": "cd signal",
    "D9110": "telephone number",  # to D9115
}
# B-3-3 and others, comments of the programs
DISPLAY = {"D9080": "display mode", "D9081": "displayed"}
DISPLAY_MODES = {3: "4-digit", 4: "two 2-digit"}
# B-4-4, BFM #28: status, and the error codes of BFM #29 below it
VB_1COM_STATUS = {
    0: "send complete",
    1: "receive complete",
    2: "receive time-out",
    3: "error occur",
    6: "data sending",
    7: "data receiving",
}
VB_1COM_CODES = {
    0: "no error",
    1: "parity, overrun",
    3: "defective receive character",
    4: "receive sum check",
    6: "baud rate setting",
    7: "receive cr",
    8: "receive lf",
    9: "initial terminator setting",
    10: "receive terminator",
}
# FNC 89 and FNC 149: the upper 8 bits of the first word of the working area
LINK_CODES = {
    0: "normal",
    2: "length",
    4: "device type",
    5: "device number",
    6: "differ",
    0xA: "no response",
    0xB: "abnormal communication",
}
# LS MASTER-K120S, MODCOM, S3: bit 0 done, bit 1 error, code in bits 8 to 15
MODCOM_CODES = {
    1: "illegal function",
    2: "illegal address",
    3: "illegal data value",
    4: "slave device failure",
    5: "acknowledge",
    6: "slave device busy",
    7: "time-out",
    8: "number error",
    9: "parameter error",
    10: "station error",
}
# LS MASTER-K120S, 8.4.3, DSND (3) Error code
DSND_CODES = {6: "parameter error", 8: "slave device busy", 9: "frame type error"}
# LS MASTER-K120S, 8.3.4: Error (F110), Zero (F111), Carry (F112)
K120S_FLAGS = {"F0110": "error", "F0111": "zero", "F0112": "carry"}
# Liyan Computer Link manual, 2-11 and 2-12; the registers, M8063 and its codes as in the manual of
# Mitsubishi that it shortens (FX communication, chapters 6, 7 and 12)
LIYAN = {
    "M8035": "forced run mode",
    "M8036": "forced run",
    "M8037": "forced stop",
    "M8063": "error",
    "M8126": "global flag",
    "D8063": "code",
    "D8120": "communication format",
    "D8120.13": "sum check",
    "D8120.15": "format 4",
    "D8121": "station number",
    "D8129": "time-out",
}
LIYAN_CODES = {0: "no error", 6301: "parity, overrun or framing", 6305: "gw", 6306: "incomplete"}
# Liyan EX485LNK, 2.18 Status BFM#28 (the table; the text below it is of another module)
EX485LNK_STATUS = {
    1: "send completion",
    3: "receive completion",
    4: "error occurrence",
    5: "output",
    6: "being sent",
    7: "being received",
}
