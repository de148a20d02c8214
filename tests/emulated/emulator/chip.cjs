// SPDX-License-Identifier: MIT
'use strict';
// An RP2040 from its reset on, with what is wired to it: flash, sensors on SPI0, a USB cable.

const { UsbHost } = require('./usb.cjs');

const SELECT_PINS = [17, 20, 21, 22, 26];
const FLASH_START = 0x10000000;
const BOARD_ID = Buffer.from('E66118604B2C3A17', 'hex');

// Peripherals by address, and registers in them (RP2040 datasheet).
const SSI = 0x18000, SSI_DR0 = 0x60, READ_UNIQUE_ID = 0x4b, UNIQUE_ID_AT = 5;
const TIMER = 0x40054, TIMERAWL = 0x28;
const WATCHDOG = 0x40058;
const SSPSR = 0x0c;

class Chip {
  // `wire` gives sensors, heard(packet), select(mask, ns) and byte(mosi, miso, hz, ns);
  // `before` is the chip as it was when its watchdog bit, or undefined at power-on.
  constructor(RP2040, rom, image, wire, startNs, before) {
    this.wire = wire;
    this.startNs = startNs;
    this.mcu = new RP2040();
    const { mcu } = this;
    mcu.logger = { debug() {}, info() {}, warn() {}, error(name, what) { throw new Error(`${name}: ${what}`); } };
    mcu.loadBootrom(rom);
    mcu.flash.set(image);
    mcu.core.PC = FLASH_START;
    this.bitten = this.stuck = false;
    const watchdog = mcu.peripherals[WATCHDOG];
    watchdog.onWatchdogTrigger = () => {
      this.bitten = true;
      watchdog.timer.enable = false; // or it would bite again at once, for ever
      this.stop(this.now());
    };
    if (before) {
      mcu.sram.set(before.mcu.sram);
      const was = before.mcu.peripherals[WATCHDOG];
      watchdog.reason = was.reason;
      watchdog.scratchData.set(was.scratchData);
    }
    this.cycleNs = 1e9 / mcu.clkSys;
    mcu.addClockListener((hz) => { this.cycleNs = 1e9 / hz; });
    this.giveUniqueId();
    this.wireSensors();
    this.skipPolls(mcu.peripherals[TIMER], TIMERAWL, () => Math.ceil((mcu.clock.nanos + 0.001) / 1000) * 1000);
    this.skipPolls(mcu.spi[0], SSPSR, () => Infinity);
    this.host = new UsbHost(mcu, wire.heard);
  }

  now() {
    return this.startNs + this.mcu.clock.nanos;
  }

  // The flash answers command 0x4B with four bytes of nothing and eight of its number.
  giveUniqueId() {
    const flash = this.mcu.peripherals[SSI];
    const write = flash.writeUint32.bind(flash);
    let at = 0;
    flash.writeUint32 = (offset, value) => {
      if (offset !== SSI_DR0 || (at === 0 && value !== READ_UNIQUE_ID)) return write(offset, value);
      flash.dr0 = at >= UNIQUE_ID_AT ? BOARD_ID[at - UNIQUE_ID_AT] : 0;
      at = at + 1 === UNIQUE_ID_AT + BOARD_ID.length ? 0 : at + 1;
    };
  }

  wireSensors() {
    const { mcu, wire } = this;
    const { clock } = mcu;
    const spi = mcu.spi[0];
    let selected = 0, answer = 0xff;
    SELECT_PINS.forEach((pin, sensor) => {
      mcu.gpio[pin].addListener((state) => {
        const bit = 1 << sensor, low = state === 0;
        if (low === !!(selected & bit)) return;
        selected ^= bit;
        wire.sensors.select(sensor, low ? 1 : 0, Math.round(this.now()));
        wire.select(selected, this.now());
      });
    });
    const done = clock.createAlarm(() => spi.completeTransmit(answer));
    spi.onTransmit = (mosi) => {
      wire.begin(mosi, selected);
      answer = selected ? wire.sensors.transfer(mosi, Math.round(this.now())) : 0xff;
      wire.byte(mosi, answer, spi.clockFrequency, this.now());
      if (!this.stuck) done.schedule((spi.dataBits * 1e9) / spi.clockFrequency);
    };
  }

  // Firmware that does nothing but read one register until it changes is taken through whole turns of
  // its loop at once, up to where the register or anything else can change: the same instructions
  // at the same times, only not one by one.
  skipPolls(peripheral, register, changesAt) {
    const { core, clock } = this.mcu;
    const read = peripheral.readUint32.bind(peripheral);
    let last = { pc: 0, value: 0, cycles: 0, turn: 0, ns: 0 };
    peripheral.readUint32 = (offset) => {
      const value = read(offset);
      if (offset !== register) return value;
      const turn = core.cycles - last.cycles;
      const again = core.PC === last.pc && value === last.value;
      if (again && turn === last.turn) {
        const until = Math.min(changesAt(), clock.nextAlarm ? clock.nextAlarm.nanos : Infinity, this.endNs);
        const turns = Math.ceil((until - clock.nanos) / (turn * this.cycleNs)) - 1;
        if (turns > 0) {
          clock.tick(turns * turn * this.cycleNs);
          core.cycles += turns * turn;
        }
      }
      last = { pc: core.PC, value, cycles: core.cycles, turn };
      return value;
    };
  }

  // Run until a time, or until `stop` is called.
  run(untilNs) {
    const { clock, core } = this.mcu;
    this.endNs = untilNs - this.startNs;
    while (clock.nanos < this.endNs) {
      if (core.waiting) {
        const next = Math.min(clock.nextAlarm ? clock.nextAlarm.nanos : Infinity, this.endNs);
        clock.tick(Math.max(next - clock.nanos, 0));
      } else {
        clock.tick(core.executeInstruction() * this.cycleNs);
      }
    }
  }

  stop(atNs) {
    this.endNs = Math.min(this.endNs, atNs - this.startNs);
  }
}

module.exports = { Chip };
