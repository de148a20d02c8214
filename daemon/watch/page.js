"use strict";
const STATES = ["idle", "closing", "settled", "judged", "released"];
const TONES = {s: "stable", l: "leans", x: "slip", u: "learning", w: "waiting", t: "trouble", ".": "silent"};
const LANES = [["x", "slip"], ["s", "stable"], ["l", "leans"], ["u", "supervised"], ["t", "act"], ["w", "wait"], [".", "silent"]];
const MARKS = {slip: "\u2715", stable: "\u25cf", unknown: "?"};
const LEFT = 70, RIGHT = 4;  // of the timeline, px
const ROWS = 12, COLUMNS = 11, FULL = 100, MOMENTS = 300, MINUTES = 5;
const QUIET_MS = 1000;  // the server sends ten times a second
const FRESH_S = .2;  // an image is of the judged grasp if the verdict is not older
const LOOK_MS = 100, AGAIN_MS = 1000;  // between two looks at the clock; between two tries
const PRESSED = [[11, "#6b3a78"], [30, "#a8326a"], [55, "#e2582e"], [80, "#f9b01c"], [100, "#fdf7a8"]];
const hands = [];
let gone = false, source = null, again = 0;
let lost = "connecting";  // why there is no connection; null while there is one
let came = now(), looked = now();
let fastest = Infinity;  // way of a snapshot on this connection, with the difference of the clocks, ms

function text(node, value) { if (node.textContent !== value) node.textContent = value; }
function percent(share) { return share < .01 ? "< 1 %" : share > .99 ? "> 99 %" : `${(100 * share).toFixed(0)} %`; }
function clock(seconds) { return new Date(1000 * seconds).toTimeString().slice(0, 8); }
function likely(grasp) { return grasp.p_slip === null ? "" : `slip probability ${percent(grasp.p_slip)}`; }
function called(grasp) { return grasp.verdict + (grasp.p_slip === null ? "" : `, ${likely(grasp)}`); }
function keyOf(grasp) { return `${grasp.boot_id} ${grasp.grasp}`; }
function rgb(hex) { return [1, 3, 5].map(at => parseInt(hex.slice(at, at + 2), 16)); }
function mix(one, other, share) {
  return `rgb(${one.map((value, at) => Math.round(value + (other[at] - value) * share)).join()})`;
}

let colours = {};
function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["rest", "risen", "mark", "track", "text", "faint", "bad", ...Object.values(TONES)])
    colours[name] = style.getPropertyValue("--" + name).trim();
}
function colour(level) {
  const rest = rgb(colours.rest);
  if (level < 0) return mix(rest, rgb(colours.risen), -level / FULL);
  let low = 0, from = rest;
  for (const [high, hex] of PRESSED) {
    if (level <= high) return mix(from, rgb(hex), (level - low) / (high - low));
    low = high; from = rgb(hex);
  }
  return PRESSED.at(-1)[1];
}

function sized(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  const context = canvas.getContext("2d");
  context.clearRect(0, 0, width, height);
  return context;
}

function children(parent, items, make, fill) {
  while (parent.children.length > items.length) parent.lastChild.remove();
  while (parent.children.length < items.length) parent.append(make());
  items.forEach((item, at) => fill(parent.children[at], item));
}
function element(name, ...inside) { const made = document.createElement(name); made.append(...inside); return made; }
function lines(parent, items) {
  children(parent, items, () => element("li", element("b"), element("span")), (node, line) => {
    text(node.children[0], line.what); text(node.children[1], ": " + line.advice);
    node.dataset.need = line.need;
  });
}
function rows(table, items) {
  children(table, items, () => element("tr", element("td"), element("td")), (node, line) => {
    text(node.children[0], line.what); text(node.children[1], line.advice);
  });
}

function drawFinger(canvas, finger) {
  const context = sized(canvas), wide = canvas.width / COLUMNS, high = canvas.height / ROWS;
  finger.levels.forEach((level, at) => {
    const x = at % COLUMNS * wide, y = Math.floor(at / COLUMNS) * high;
    context.fillStyle = colour(level);
    const left = Math.round(x), top = Math.round(y);
    context.fillRect(left, top, Math.round(x + wide) - left - 1, Math.round(y + high) - top - 1);
  });
  context.strokeStyle = colours.mark; context.lineWidth = Math.max(wide / 7, 1.5);
  for (const at of finger.marked) {
    const x = at % COLUMNS * wide, y = Math.floor(at / COLUMNS) * high, in_ = .22;
    context.beginPath();
    context.moveTo(x + wide * in_, y + high * in_); context.lineTo(x + wide * (1 - in_), y + high * (1 - in_));
    context.moveTo(x + wide * (1 - in_), y + high * in_); context.lineTo(x + wide * in_, y + high * (1 - in_));
    context.stroke();
  }
}

// Up to the mark in the middle a finger is still; at the right end it moves twice as much.
function drawMotion(bar, words, motion) {
  bar.hidden = words.hidden = motion === null;
  if (motion === null) return;
  const {now, limit} = motion;
  bar.dataset.motion = now === null ? "unknown" : now > limit ? "moving" : "still";
  bar.style.setProperty("--share", `${now === null ? 0 : Math.min(50 * now / limit, 100)}%`);
  text(words, now === null ? "motion not known" : `motion ${now.toFixed(1)} / ${limit.toFixed(1)} \u03c3`);
}

// A second of the timeline in words; `ago` counts from the end of the history.
function momentOf(minutes, ago) {
  const at = minutes.history.length - 1 - ago;
  if (at < 0) return "no second here: watch began later";
  const codes = minutes.history[at], names = LANES.filter(([code]) => codes.includes(code)).map(([, name]) => name);
  const share = minutes.probability[at];
  const probability = share < 0 ? "no slip probability" : `highest slip probability ${percent(share / 100)}`;
  return `${clock(minutes.t - ago)}: ${names.join(", ") || "watch stood still"}; ${probability}`;
}

// A lane for each kind of verdict, below it the probability of slip, and the minutes before the end.
function drawTimeline(canvas, minutes, end, pointed) {
  const {history, probability} = minutes;
  const context = sized(canvas), ratio = window.devicePixelRatio || 1;
  const left = LEFT * ratio, lane = 12 * ratio, bottom = canvas.height - 16 * ratio, top = LANES.length * lane + 10 * ratio;
  const step = (canvas.width - left - RIGHT * ratio) / MOMENTS, start = MOMENTS - history.length;
  const size = 2.8 * ratio, level = share => bottom - (bottom - top) * share / 100;
  context.font = `${11 * ratio}px system-ui, sans-serif`; context.textBaseline = "middle";
  for (let minute = 0; minute <= MINUTES; minute++) {
    const x = left + minute * MOMENTS / MINUTES * step;
    const unit = minute && canvas.width < 560 * ratio ? "" : " min";
    const label = minute === MINUTES ? end : `\u2212${MINUTES - minute}${unit}`;
    context.fillStyle = colours.track; context.fillRect(x, 0, ratio, bottom + 4 * ratio);
    context.fillStyle = colours.faint; context.textAlign = minute === MINUTES ? "right" : minute ? "center" : "left";
    context.fillText(label, x, canvas.height - 6 * ratio);
  }
  context.textAlign = "right";
  for (const share of [0, 50, 100]) {
    context.fillStyle = colours.track; context.fillRect(left, level(share), canvas.width - left, ratio);
    context.fillStyle = colours.faint; context.fillText(`${share} %`, left - 6 * ratio, level(share));
  }
  LANES.forEach(([code, name], row) => {
    const y = row * lane;
    context.fillStyle = colours.faint; context.fillText(name, left - 6 * ratio, y + lane / 2);
    context.fillStyle = code === "w" ? colours.faint : colours[TONES[code]];
    for (let at = 0; at < history.length; at++)
      if (history[at].includes(code)) context.fillRect(left + (start + at) * step, y + 2 * ratio, step + .6, lane - 4 * ratio);
  });
  context.lineWidth = 1.5 * ratio;
  probability.forEach((share, at) => {
    if (share < 0) return;
    const x = left + (start + at + .5) * step, y = level(share), slip = history[at].includes("x");
    context.beginPath();
    context.strokeStyle = context.fillStyle = slip ? colours.bad : colours.leans;
    if (slip) {
      context.moveTo(x - size, y - size); context.lineTo(x + size, y + size);
      context.moveTo(x + size, y - size); context.lineTo(x - size, y + size);
    } else context.arc(x, y, size, 0, 2 * Math.PI);
    if (history[at].includes("s")) context.fill(); else context.stroke();
  });
  if (pointed !== null) {
    context.fillStyle = colours.text;
    context.fillRect(left + (MOMENTS - 1 - pointed + .5) * step, 0, ratio, bottom);
  }
  const seconds = LANES.map(([code, name]) => [name, history.filter(each => each.includes(code)).length]);
  canvas.ariaLabel = "verdicts by second: " + seconds.filter(([, count]) => count).map(([name, count]) => `${name} ${count} s`).join(", ");
}

class Hand {
  constructor() {
    this.seen = null;
    this.root = document.getElementById("hand").content.firstElementChild.cloneNode(true);
    this.parts = {};
    this.images = new Map();  // of each grasp in the list that this page saw judged
    this.chosen = null;  // key of the grasp whose image is shown; null: the image of now
    this.paused = null;  // the minutes that are shown while paused
    this.pointed = null;  // second of the timeline below the pointer, counted from its end
    document.getElementById("hands").append(this.root);
    this.listen();
  }
  listen() {
    const line = this.part("timeline");
    this.part("pause").onclick = () => { if (this.seen !== null) this.paused = this.paused === null ? this.minutes(0) : null; draw(); };
    this.part("live").onclick = () => { this.chosen = null; draw(); };
    this.part("grasps").onclick = event => {
      const row = event.target.closest("tr"), at = [...this.part("grasps").children].indexOf(row);
      if (at < 0 || this.seen === null) return;
      const key = keyOf(this.seen.grasps[at]);
      this.chosen = this.chosen === key ? null : key;
      draw();
    };
    line.onpointermove = line.onpointerdown = event => {
      const share = (event.offsetX - LEFT) / (line.clientWidth - LEFT - RIGHT);
      this.pointed = share < 0 || share >= 1 ? null : MOMENTS - 1 - Math.floor(share * MOMENTS);
      draw();
    };
    line.onpointerleave = () => { this.pointed = null; draw(); };
  }
  take(snapshot) {
    this.seen = snapshot;
    const newest = snapshot.grasps[0], keys = snapshot.grasps.map(keyOf);
    if (newest !== undefined && newest.held && newest.ago_s < FRESH_S && snapshot.fingers.length)
      this.images.set(keyOf(newest), snapshot.fingers);
    for (const key of this.images.keys()) if (!keys.includes(key)) this.images.delete(key);
    if (!keys.includes(this.chosen)) this.chosen = null;
  }
  // The last five minutes; where nothing comes, they move on.
  minutes(quiet) {
    const missed = Math.min(Math.floor(quiet / 1000), MOMENTS), seen = this.seen;
    return {
      t: seen.t + missed, history: [...seen.history, ...Array(missed).fill(".")].slice(-MOMENTS),
      probability: [...seen.history_p, ...Array(missed).fill(-1)].slice(-MOMENTS),
    };
  }
  part(name) { return this.parts[name] ??= this.root.querySelector("." + name); }
  say(name, value) { text(this.part(name), value); }

  draw(quiet) {
    const seen = this.seen, none = gone || seen === null, tone = this.tone();
    this.say("clock", clock(Date.now() / 1000));
    this.part("banner").dataset.tone = tone;
    this.say("verdict", this.headline());
    this.part("verdict").classList.toggle("words", this.headline().includes(" "));
    const p = none ? null : seen.p_slip, last = none ? null : seen.grasps[0] ?? null;
    const was = last !== null && (tone === "waiting" || tone === "learning") && last.verdict !== "unknown";
    this.say("was", was && last.grasp === seen.grasp ? `${last.held ? "judged" : "past:"} ${called(last)}` : "");
    this.say("evidence", none ? "" : seen.evidence);
    this.say("p", p === null ? "no probability" : `slip probability ${percent(p)}`);
    this.part("gauge").ariaValueNow = p === null ? null : (100 * p).toFixed(0);
    this.part("gauge").firstElementChild.style.width = `${p === null ? 0 : 100 * p}%`;
    lines(this.part("why"), none ? [trouble(quiet)] : seen.why);
    const old = tone === "silent";
    this.root.classList.toggle("gone", old);
    this.say("old", !old || seen === null || seen.last_t === null ? "" :
      `figures are of ${clock(seen.last_t)}, the last message`);
    if (seen === null) return;
    this.say("who", `graspd ${seen.hand ?? ""}`);
    this.root.ariaLabel = `hand ${seen.hand ?? ""}`;
    this.say("state", none ? "-" : seen.state ?? "-");
    this.say("model", seen.model ?? "no model yet");
    this.say("where", none ? seen.endpoint : `${seen.endpoint} ${seen.link}`);
    this.drawGrasp(none, quiet);
    this.drawImages(none);
    this.drawMinutes(quiet);
    const joints = Object.entries(none ? {} : seen.joints).sort();
    this.say("joints-title", joints.length ? "Joints" : "No joints");
    children(this.part("joints"), joints, () => element("div", element("span"), element("b")), (node, [name, angle]) => {
      text(node.children[0], name); text(node.children[1], `${(angle * 180 / Math.PI).toFixed(1)}\u00b0`);
    });
    const well = {need: "normal", what: "well", advice: "nothing to do"};
    const unknown = {need: "normal", what: "not known", advice: "no status comes"};
    lines(this.part("health"), none || seen.state === null ? [unknown] : seen.health.length ? seen.health : [well]);
    this.drawTables();
  }
  drawMinutes(quiet) {
    const minutes = this.paused ?? this.minutes(quiet), paused = this.paused !== null;
    drawTimeline(this.part("timeline"), minutes, paused ? clock(minutes.t) : "now", this.pointed);
    this.part("time").classList.toggle("paused", paused);
    this.say("minutes", paused ? `Paused: five minutes until ${clock(minutes.t)}` : "Last five minutes: verdicts of each second");
    this.say("pause", paused ? "resume" : "pause");
    this.say("at", this.pointed === null ? "" : momentOf(minutes, this.pointed));
    this.part("at").hidden = this.pointed === null;
    this.part("key").hidden = this.pointed !== null;
  }
  drawImages(none) {
    const past = this.seen.grasps.find(grasp => keyOf(grasp) === this.chosen);
    const images = past === undefined ? none ? [] : this.seen.fingers : this.images.get(this.chosen) ?? [];
    this.part("tactile").classList.toggle("past", past !== undefined);
    this.part("live").hidden = past === undefined;
    this.part("stillness").hidden = past !== undefined;
    const of = past === undefined ? "" : `Grasp ${past.grasp} as it was judged: ${called(past)}`;
    this.say("images", past === undefined ? "Tactile images and motion" :
      images.length ? of : `${of}; this page has no image of it`);
    this.drawFingers(images);
  }
  tone() { return gone || this.seen === null ? "silent" : this.seen.tone; }
  word() { return gone || this.seen === null ? "no connection" : this.seen.why[0]?.what ?? ""; }
  headline() {
    if (this.seen === null || this.seen.last_t === null) return "no verdict yet";
    return gone ? "unknown" : this.seen.headline;
  }

  drawGrasp(none, quiet) {
    const seen = this.seen, gate = none ? null : seen.gate, newest = seen.grasps[0] ?? null;
    this.say("grasp", String(seen.grasp ?? "-"));
    children(this.part("gate"), STATES, () => element("li"), (node, state) => {
      text(node, state); node.className = state === gate ? "now" : "";
      node.ariaCurrent = state === gate ? "step" : null;
    });
    const ago = newest === null ? 0 : newest.ago_s + quiet / 1000;
    this.say("judged", newest === null || none || seen.tone === "silent" ? "-" :
      `${called(newest)}, ${ago.toFixed(0)} s ago${newest.held ? "" : ", past"}${newest.lift === "-" ? "" : `; lift: ${newest.lift}`}`);
    this.say("still", none ? "-" : seen.still);
  }

  drawFingers(fingers) {
    children(this.part("fingers"), fingers,
      () => element("figure", element("figcaption", element("b"), element("span"), element("span")), element("canvas"), element("div"), element("span"), element("b")),
      (node, finger) => {
        const [name, touch, depth] = node.children[0].children, [, canvas, bar, words, broken] = node.children;
        text(name, finger.name);
        text(touch, finger.state ?? "");
        touch.className = finger.state === "free" ? "faint" : "touch"; touch.dataset.state = finger.state;
        text(depth, finger.from_rest ? `${finger.deepest} counts` : "");
        canvas.role = "img"; canvas.ariaLabel = `tactile image of ${finger.name}: ${touch.textContent} ${depth.textContent}`;
        drawFinger(canvas, finger);
        bar.className = "moves"; words.className = "faint";
        drawMotion(bar, words, finger.motion);
        text(broken, finger.broken && `\u2715 ${finger.broken}`); broken.hidden = finger.broken === "";
      });
    const canvas = this.part("legend").querySelector("canvas"), context = sized(canvas);
    for (let x = 0; x < canvas.width; x++) {
      context.fillStyle = colour(-25 + 125 * x / canvas.width);
      context.fillRect(x, 0, 1, canvas.height);
    }
    const rest = fingers.length === 0 || fingers[0].from_rest;
    this.say("scale", fingers.length === 0 ? "no readings to see" :
      `pressed, ${rest ? "to 1600 counts below rest" : "below the finger's own median"}; \u2715 broken`);
  }

  drawTables() {
    children(this.part("grasps"), this.seen.grasps,
      () => element("tr", element("td", element("button")), element("td", element("i"), element("span")), element("td"), element("td")),
      (node, grasp) => {
        text(node.children[0].firstChild, String(grasp.grasp));
        node.className = keyOf(grasp) === this.chosen ? "chosen" : "";
        const [mark, word] = node.children[1].children;
        mark.dataset.verdict = grasp.verdict; text(mark, MARKS[grasp.verdict]);
        text(word, grasp.verdict);
        text(node.children[2], grasp.p_slip === null ? "" : percent(grasp.p_slip));
        text(node.children[3], grasp.lift + (grasp.supervised ? ", supervised" : ""));
        node.children[3].className = !["held", "slipped"].includes(grasp.lift) ? "faint" : grasp.verdict === "stable" && grasp.lift === "slipped" ? "bad" : "";
      });
    for (const name of ["learning", "timing"]) rows(this.part(name), this.seen[name]);
  }
}

// Two clocks: the first stands still while the computer sleeps, the second may be set.
function now() { return [performance.now(), Date.now()]; }
function since(moment) { const [steady, wall] = now(); return Math.max(steady - moment[0], wall - moment[1]); }
function trouble(quiet) {
  if (document.hidden) return {what: "not looked at", advice: "this page is in the background"};
  const why = lost === null ? "" : `${lost}; `;
  return {what: "no connection", advice: `${why}no message from graspd watch for ${quiet.toFixed(0)} ms`};
}

function draw() {
  const quiet = since(came);
  gone = lost !== null || document.hidden || quiet > QUIET_MS;
  for (const hand of hands) hand.draw(quiet);
  drawStrip();
  const said = hands.map(hand => (hands.length > 1 ? `${hand.seen?.hand ?? "?"} ` : "") + hand.headline());
  document.title = `${said.join(", ")} - graspd`;
}

function drawStrip() {
  const strip = document.getElementById("strip");
  strip.hidden = hands.length < 2;
  document.getElementById("hands").classList.toggle("several", hands.length > 1);
  children(strip, hands, () => element("a", element("span"), element("b"), element("span"), element("span")), (node, hand) => {
    const id = `hand-${hands.indexOf(hand)}`;
    hand.root.id = id; node.href = `#${id}`; node.dataset.tone = hand.tone();
    text(node.children[0], hand.seen?.hand ?? "?"); text(node.children[1], hand.headline());
    text(node.children[2], hand.word()); text(node.children[3], gone ? "" : hand.seen?.not_well ?? "");
  });
}

function lose(why) {
  if (lost === null || hands[0].seen === null) lost = why;
  draw();
}
function connect() {
  clearTimeout(again);
  if (source !== null) source.close();
  source = new EventSource("/events");
  source.onopen = () => { fastest = Infinity; };
  source.onerror = () => {
    lose("graspd watch does not answer");
    if (source.readyState === EventSource.CLOSED) { clearTimeout(again); again = setTimeout(connect, AGAIN_MS); }
  };
  source.onmessage = event => {
    if (!look()) return;  // it waited: what comes on the new connection counts
    const snapshots = JSON.parse(event.data), way = Date.now() - 1000 * snapshots[0].t;
    fastest = Math.min(fastest, way);
    if (way - fastest > QUIET_MS) { lose("old messages come"); connect(); return; }
    while (hands.length > snapshots.length) hands.pop().root.remove();
    snapshots.forEach((snapshot, at) => { (hands[at] ??= new Hand()).take(snapshot); });
    came = now(); lost = null;
    draw();
  };
}
// Whether this page was awake since the last look; if not, nothing that it shows or that waits holds.
function look() {
  const awake = since(looked) <= QUIET_MS;
  looked = now();
  if (!awake) { lose("this page slept"); connect(); }
  return awake;
}

readColours();
hands.push(new Hand());
connect();
setInterval(() => { if (look() && (lost !== null || since(came) > QUIET_MS)) draw(); }, LOOK_MS);
document.addEventListener("visibilitychange", () => { look(); draw(); });
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readColours(); draw(); });
addEventListener("resize", draw);
draw();
