// SPDX-License-Identifier: MIT
'use strict';
// The bridge's board as a process in lock-step: one command as a line of JSON on standard input, its
// answer as a line on standard output. Emulated time moves by `run` alone, as far as it is told.
// usage: node main.cjs FOLDER (with node_modules and sensors.node) BOOTROM

const fs = require('fs');
const path = require('path');
const { Chip } = require('./chip.cjs');

const [folder, romFile] = process.argv.slice(2);
const { GPIOPinState, RP2040 } = require(require.resolve('rp2040js', { paths: [folder] }));
const sensors = require(path.resolve(folder, 'sensors.node'));
const romBytes = fs.readFileSync(romFile);
const rom = new Uint32Array(romBytes.buffer.slice(romBytes.byteOffset, romBytes.byteOffset + 16384));

const FRAME_NS = 1_000_000; // the host's controller hands over what has come once a millisecond
const SELECT = 0, BYTE = 1; // kinds of recorded events
const LIGHT_PIN = 25; // the Pico's own
const EVENT_BYTES = 16; // f64 time in ns, u32 clock in Hz, u8 kind, u8 value (mask or MOSI), u8 MISO, u8 0
const EVENTS_MAX = 2_000_000;

let chip = null, image = null, idleNs = 0; // the time of a board without power
let heard = [], handsOver = false, handOverNs = Infinity;
let isOpen = false, resets = 0, sweeps = 0, row = 0, firstCommand = -1, bytesOfSelection = 0;
let recording = null, recorded = 0;

const now = () => (chip ? chip.now() : idleNs);

function record(kind, value, miso, hz, ns) {
  if (!recording) return;
  if (recorded === EVENTS_MAX) throw new Error('the recording is full');
  const at = EVENT_BYTES * recorded++;
  recording.setFloat64(at, ns, true);
  recording.setUint32(at + 8, hz, true);
  recording.setUint8(at + 12, kind);
  recording.setUint8(at + 13, value);
  recording.setUint8(at + 14, miso);
}

const wire = {
  sensors,
  select(mask, ns) {
    bytesOfSelection = 0;
    record(SELECT, mask, 0, 0, ns);
  },
  // Before a byte is clocked: the first command of a sequence begins a sweep, and the sensors get the
  // counts of the next row.
  begin(mosi, selected) {
    if (bytesOfSelection++ > 0 || !selected || !(mosi & 0x80)) return;
    if (firstCommand < 0) firstCommand = mosi;
    if (mosi !== firstCommand) return;
    sweeps++;
    sensors.row(row++);
  },
  byte(mosi, miso, hz, ns) {
    record(BYTE, mosi, miso, hz, ns);
  },
  heard(packet) {
    if (packet.length === 0) return;
    heard.push([now(), Buffer.from(packet).toString('hex')]);
    if (!handsOver || handOverNs < Infinity) return;
    handOverNs = Math.ceil(now() / FRAME_NS) * FRAME_NS;
    chip.stop(handOverNs);
  },
};

function start(before) {
  chip = new Chip(RP2040, rom, image, wire, now(), before);
  if (isOpen) chip.host.open();
}

const commands = {
  // Power comes, with this image in the flash; the sensors' counts begin again.
  power({ file }) {
    image = fs.readFileSync(file);
    sensors.init('');
    firstCommand = -1;
    sweeps = row = resets = 0;
    start();
  },
  // The cable, of a board that is fed otherwise.
  detach: () => chip.host.detach(),
  attach: () => chip.host.attach(),
  // Run until a time; `hand_over`: only until bytes have come and a millisecond is full.
  run({ until, hand_over: handOver }) {
    handsOver = handOver;
    while (now() < Math.min(until, handOverNs)) {
      if (!chip) {
        idleNs = until;
        break;
      }
      chip.run(Math.min(until, handOverNs));
      if (chip.bitten) {
        resets++;
        start(chip);
      }
    }
    const packets = heard;
    heard = [];
    handOverNs = Infinity;
    return { packets };
  },
  open() {
    isOpen = true;
    chip?.host.open();
  },
  close() {
    isOpen = false;
    chip?.host.close();
  },
  // How many bytes the host takes before it reads again.
  read: ({ room }) => chip.host.read(room ?? Infinity),
  send: ({ bytes }) => chip.host.send(Buffer.from(bytes, 'hex')),
  // The next sweep is row 0 of the counts again.
  rewind() {
    row = 0;
    firstCommand = -1;
  },
  sensor({ sensor, what, values }) {
    if (!['unplug', 'settle', 'dead', 'force'].includes(what)) throw new Error(`no such fault: ${what}`);
    sensors[what](sensor, ...values);
  },
  // The SPI block never finishes the byte at hand, until the next reset.
  stick() {
    chip.stuck = true;
  },
  record() {
    recording = new DataView(new ArrayBuffer(EVENT_BYTES * EVENTS_MAX));
    recorded = 0;
  },
  recorded({ file }) {
    fs.writeFileSync(file, new Uint8Array(recording.buffer, 0, EVENT_BYTES * recorded));
    recording = null;
  },
  state() {
    const { host, mcu } = chip ?? {};
    const spi = mcu?.spi[0];
    return {
      powered: chip !== null, configured: host?.configured ?? false, dtr: host?.dtr ?? false,
      device: host?.device ?? '', strings: host?.strings ?? [], resets, sweeps,
      sys_hz: mcu?.clkSys ?? 0, spi_hz: spi?.clockFrequency ?? 0,
      spi_mode: spi?.spiMode ?? 0, spi_bits: spi?.dataBits ?? 0,
      light: mcu?.gpio[LIGHT_PIN].value === GPIOPinState.High,
    };
  },
};

// Standard input, line by line, without an event loop in between.
const chunk = Buffer.alloc(65536);
let unread = '';
for (;;) {
  const end = unread.indexOf('\n');
  if (end < 0) {
    const size = fs.readSync(0, chunk);
    if (size === 0) break;
    unread += chunk.toString('latin1', 0, size);
    continue;
  }
  let answer;
  try {
    const { do: name, ...rest } = JSON.parse(unread.slice(0, end));
    answer = { ...commands[name](rest), now: now() };
  } catch (error) {
    answer = { error: error.stack };
  }
  unread = unread.slice(end + 1);
  const line = Buffer.from(`${JSON.stringify(answer)}\n`);
  for (let at = 0; at < line.length; ) at += fs.writeSync(1, line, at);
}
