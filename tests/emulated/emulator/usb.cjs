// SPDX-License-Identifier: MIT
'use strict';
// The computer at the other end of the cable: enumerates the board as Linux does, opens its serial
// port (CDC), asks for packets only while somebody reads, and ticks once a millisecond.

const PACKET_NS = 50_000; // 64 bytes with their handshake at full speed
const CONTROL_NS = 100_000; // from one control transfer to the next
const FRAME_NS = 1_000_000;
const SUSPEND_NS = 3_000_000; // a bus that is silent for so long sleeps
const PACKET_BYTES = 64;

// Registers of the controller and bits in them (RP2040 datasheet 4.1.4), as far as rp2040js lacks them.
const EP0_IN_BUFFER = 0x80, EP15_OUT_BUFFER = 0xfc, AVAILABLE = 1 << 10;
const SOF_RD = 0x48, SIE_STATUS = 0x50, SUSPENDED = 1 << 4, DEV_SOF = 1 << 17;

const DEVICE = 1, CONFIGURATION = 2, STRING = 3, INTERFACE = 4, ENDPOINT = 5, DATA_CLASS = 10;

const setup = (type, request, value, index, length) =>
  Uint8Array.from([type, request, value & 255, value >> 8, index & 255, index >> 8, length & 255, length >> 8]);
const getDescriptor = (type, index, length) =>
  setup(0x80, 6, (type << 8) | index, type === STRING ? 0x0409 : 0, length);
const SET_ADDRESS = setup(0x00, 5, 1, 0, 0);
const SET_CONFIGURATION = setup(0x00, 9, 1, 0, 0);
const SET_LINE_CODING = setup(0x21, 0x20, 0, 0, 7);
const LINE_CODING = Uint8Array.from([0x00, 0x10, 0x0e, 0x00, 0, 0, 8]); // 921600 baud, 8N1
const setControlLines = (lines) => setup(0x21, 0x22, lines, 0, 0);

class UsbHost {
  // `heard(packet)` is called with what the board says while its port is open.
  constructor(mcu, heard) {
    this.usb = mcu.usbCtrl;
    this.memory = mcu.usbDPRAMView;
    this.heard = heard;
    this.strings = [];
    this.room = Infinity; // bytes that are taken before somebody has to read
    this.isOpen = this.attached = false;
    this.pause = mcu.clock.createAlarm(() => this.nextControl());
    this.polls = Array.from({ length: 16 }, (_, endpoint) => mcu.clock.createAlarm(() => this.ask(endpoint)));
    this.sof = mcu.clock.createAlarm(() => this.frame());
    this.silence = mcu.clock.createAlarm(() => this.suspend());
    this.forget();
    this.mendController();
    this.usb.onUSBEnabled = () => this.attach();
    this.usb.onResetReceived = () => this.enumerate();
    this.usb.onEndpointWrite = (endpoint, packet) => this.take(endpoint, packet);
    this.usb.onEndpointRead = (endpoint, size) => this.mayGive(endpoint, size);
  }

  // What rp2040js does otherwise: a packet leaves as soon as the board has it ready, and neither
  // frames nor sleep can be told and acknowledged.
  mendController() {
    const { usb } = this;
    const send = usb.DPRAMUpdated.bind(usb);
    usb.writeDelayMicroseconds = 0; // the time on the wire is counted here
    usb.DPRAMUpdated = (offset, value) => {
      if (offset < EP0_IN_BUFFER || offset > EP15_OUT_BUFFER || offset & 4) return send(offset, value);
      const endpoint = (offset - EP0_IN_BUFFER) >> 3;
      if (!(value & AVAILABLE)) return this.ready.delete(endpoint);
      this.ready.add(endpoint);
      this.poll(endpoint);
    };
    this.fetch = (endpoint) => {
      const offset = EP0_IN_BUFFER + 8 * endpoint;
      send(offset, this.memory.getUint32(offset, true));
    };
    const read = usb.readUint32.bind(usb), write = usb.writeUint32.bind(usb);
    usb.readUint32 = (offset) => {
      if (offset === SOF_RD) {
        usb.intRaw &= ~DEV_SOF;
        usb.checkInterrupts();
      }
      return read(offset);
    };
    usb.writeUint32 = (offset, value) => {
      if (offset === SIE_STATUS) usb.sieStatus &= ~(usb.rawWriteValue & SUSPENDED);
      write(offset, value);
    };
  }

  // All that a reset of the bus undoes.
  forget() {
    this.controls = [];
    this.control = null;
    this.configured = this.dtr = false;
    this.inEndpoint = this.outEndpoint = -1;
    this.outSize = -1;
    this.toBoard = [];
    this.ready = new Set();
  }

  // ---- the cable ----

  attach() {
    if (this.attached) return;
    this.attached = true;
    this.silence.cancel();
    this.forget();
    this.usb.resetDevice();
  }

  detach() {
    this.attached = false;
    this.forget();
    this.pause.cancel();
    this.sof.cancel();
    this.silence.schedule(SUSPEND_NS);
  }

  suspend() {
    this.usb.sieStatus |= SUSPENDED;
    this.usb.sieStatusUpdated();
  }

  frame() {
    this.sof.schedule(FRAME_NS);
    this.usb.sofFrameNumber = (this.usb.sofFrameNumber + 1) & 0x7ff;
    this.usb.intRaw |= DEV_SOF;
    this.usb.checkInterrupts();
  }

  // ---- control transfers, one after the other ----

  enumerate() {
    if (!this.attached) return;
    this.sof.schedule(FRAME_NS);
    const ask = (type, index, length, done) => this.demand({ packet: getDescriptor(type, index, length), done });
    const text = (bytes) => this.strings.push(Buffer.from(bytes.slice(2)).toString('utf16le'));
    this.strings.length = 0;
    this.demand({ packet: SET_ADDRESS });
    ask(DEVICE, 0, 18, (device) => {
      this.device = Buffer.from(device).toString('hex');
      for (const index of device.slice(14, 17)) if (index > 0) ask(STRING, index, 255, text);
      ask(CONFIGURATION, 0, 9, (head) => {
        ask(CONFIGURATION, 0, head[2] | (head[3] << 8), (all) => {
          this.findEndpoints(all);
          this.demand({ packet: SET_CONFIGURATION, done: () => {
            this.configured = true;
            if (this.isOpen) this.setLines();
          } });
        });
      });
    });
  }

  findEndpoints(descriptors) {
    let isData = false;
    for (let at = 0; descriptors[at] > 0; at += descriptors[at]) {
      const kind = descriptors[at + 1], address = descriptors[at + 2];
      if (kind === INTERFACE) isData = descriptors[at + 5] === DATA_CLASS;
      if (kind !== ENDPOINT || !isData) continue;
      if (address & 0x80) this.inEndpoint = address & 15;
      else this.outEndpoint = address & 15;
    }
  }

  demand(control) {
    this.controls.push(control);
    if (!this.control && !this.pause.scheduled) this.pause.schedule(CONTROL_NS);
  }

  nextControl() {
    this.pause.scheduled = false;
    this.control = this.controls.shift() ?? null;
    if (!this.control) return;
    this.control.bytes = [];
    this.usb.sendSetupPacket(this.control.packet);
  }

  finishControl() {
    const { done, bytes } = this.control;
    this.control = null;
    this.pause.schedule(CONTROL_NS);
    done?.(bytes);
  }

  takeControl(packet) {
    const { control } = this;
    if (!control) return;
    if (!(control.packet[0] & 0x80)) return this.finishControl();
    control.bytes.push(...packet);
    control.whole = packet.length < PACKET_BYTES || control.bytes.length >= (control.packet[6] | (control.packet[7] << 8));
  }

  // ---- the serial port ----

  open() {
    this.isOpen = true;
    if (this.configured) this.setLines();
  }

  close() {
    this.isOpen = this.dtr = false; // what was written before still goes
    if (this.configured) this.demand({ packet: setControlLines(0) });
  }

  setLines() {
    this.demand({ packet: SET_LINE_CODING, data: LINE_CODING });
    this.demand({ packet: setControlLines(3), done: () => {
      this.dtr = this.isOpen;
      this.poll(this.inEndpoint);
    } });
  }

  read(room) {
    this.room = room;
    if (this.inEndpoint > 0) this.poll(this.inEndpoint);
  }

  send(bytes) {
    this.toBoard.push(...bytes);
    this.give();
  }

  // ---- packets ----

  wants(endpoint) {
    return endpoint === 0 || (this.isOpen && this.configured && this.room > 0);
  }

  poll(endpoint) {
    if (this.ready.has(endpoint) && !this.polls[endpoint].scheduled) this.polls[endpoint].schedule(PACKET_NS);
  }

  ask(endpoint) {
    this.polls[endpoint].scheduled = false;
    if (!this.ready.has(endpoint) || !this.attached || !this.wants(endpoint)) return;
    this.ready.delete(endpoint);
    this.fetch(endpoint);
  }

  take(endpoint, packet) {
    if (endpoint === 0) this.takeControl(packet);
    else if (endpoint === this.inEndpoint) {
      this.room -= packet.length;
      this.heard(packet);
    }
  }

  mayGive(endpoint, size) {
    if (endpoint === 0) {
      this.usb.endpointReadDone(0, this.control?.data ?? new Uint8Array(0));
      if (this.control?.whole) this.finishControl();
    } else if (endpoint === this.outEndpoint) {
      this.outSize = size;
      this.give();
    }
  }

  give() {
    if (this.outSize < 0 || this.toBoard.length === 0 || !this.configured) return;
    const packet = Uint8Array.from(this.toBoard.splice(0, this.outSize));
    this.outSize = -1;
    this.usb.endpointReadDone(this.outEndpoint, packet, PACKET_NS / 1000);
  }
}

module.exports = { UsbHost };
