// The operator's screen. It stores the data from the server, and draws the data while the page is visible.

import {Section, forceColor, wearColor} from "./section.js";
import {Charts} from "./charts.js";

const by = (id) => document.getElementById(id);
const LEVELS = ["OK", "WARN", "ERROR"];
const CLASSES = ["", "warn", "error"];
const KEEP_S = 3600;
const OLD_S = 3;
const UNITS = {force: ["kN", 1e-3, 1], clearance: ["mm", 1e3, 3], residual: ["mm", 1e3, 2], clearance_rate: ["mm/h", 3.6e6, 3], wear_rate: ["mm/h", 3.6e6, 3]};
const SOURCES = {
  prior: "assumed", estimated: "estimated", rough: "rough estimate",
  not_observable: "not observable", withdrawn: "withdrawn",
};

const state = {facts: null, parts: {}, events: [], seconds: [], motion: null, news: {}, heard: 0};
let section = null, charts = null, socket = null, wait = 500;
const token = {value: sessionStorage.getItem("token") ?? ""};

// the token follows # in the address, so that the browser never sends the token
if (location.hash.startsWith("#token=")) {
  token.value = decodeURIComponent(location.hash.slice(7));
  sessionStorage.setItem("token", token.value);
  history.replaceState(null, "", location.pathname);
}

const fixed = (value, digits) => (value === null || value === undefined || !Number.isFinite(Number(value)) ? "–" : Number(value).toFixed(digits).replace("-", "−"));
const kilo = (newton) => fixed(newton === null ? null : newton / 1e3, 1);
const depth = (metre) => (metre === undefined || metre === null ? "–" : metre >= 1e-3 ? `${fixed(metre * 1e3, 2)} mm` : `${fixed(metre * 1e6, 1)} µm`);
const padName = (name) => { const words = name.split("_"); const wall = words.pop(); return `${words.join(" ")}, ${wall} wall`; };
const clock = (seconds) => (seconds > 1e9 ? new Date(seconds * 1e3).toLocaleTimeString("en-GB") : `${fixed(seconds, 1)} s`);
// Formats a time with date and zone. All times on the page are in the time zone of the browser.
const moment = (seconds) => (seconds > 1e9 ? new Date(seconds * 1e3).toLocaleString("en-GB", {dateStyle: "medium", timeStyle: "long"}) : clock(seconds));

function cell(row, text, kind = "") {
  const found = row.insertCell();
  found.className = kind;
  found.textContent = text;
  return found;
}

function rows(id, contents) {
  const body = by(id).tBodies[0];
  body.replaceChildren();
  for (const content of contents) {
    const row = body.insertRow();
    for (const [text, kind] of content) cell(row, text, kind);
  }
}

function connect() {
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/data`);
  socket.onopen = () => { if (token.value) socket.send(JSON.stringify({token: token.value})); };
  socket.onmessage = (event) => { wait = 500; take(JSON.parse(event.data)); };
  socket.onclose = (event) => {
    state.closed = event.code === 1001 ? "the twin has ended" : event.code === 1013 ? "too many pages are open" : "the connection is lost";
    if (event.code === 4401) {
      by("door").hidden = false;
      state.closed = token.value ? "the token is wrong" : "a token is needed";
      show();
      return;
    }
    show();
    setTimeout(connect, wait);
    wait = Math.min(5000, 2 * wait);
  };
}

function take(message) {
  state.closed = "";
  state.heard = performance.now();
  state.news = message;
  if (message.facts) {
    state.facts = message.facts;
    section = new Section(by("section"), message.facts);
    charts?.destroy();
    charts = new Charts(message.facts);
    document.title = `plow_twin ${message.facts.scene}`;
  }
  Object.assign(state.parts, message.parts);
  state.events.push(...(message.events ?? []));
  state.events.splice(0, state.events.length - 200);
  if (message.anew) state.seconds = [];
  for (const row of message.seconds ?? []) {
    while (state.seconds.length && state.seconds.at(-1)[0] >= row[0]) state.seconds.pop();
    state.seconds.push(row);
  }
  const first = (state.seconds.at(-1)?.[0] ?? 0) - KEEP_S;
  let old = 0;
  while (old < state.seconds.length && state.seconds[old][0] < first) old += 1;
  state.seconds.splice(0, old);
  if (message.motion) state.motion = message.motion;
  state.changed = true;
}

const wish = (what, text = "") => { if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify({do: what, text})); };
const part = (name) => state.parts[name] ?? [0, "", {}];
const values = (name) => part(name)[2];

function extremes() {
  const span = Number(by("window").value), end = state.seconds.at(-1)?.[0] ?? 0;
  const shown = state.seconds.filter((row) => row[0] > end - span);
  const largest = Array.from({length: 8}, (_, pad) => Math.max(0, ...shown.map((row) => row[1 + pad] ?? 0)));
  const now = state.seconds.filter((row) => row[0] >= end - 1);
  const peak = Array.from({length: 8}, (_, pad) => Math.max(0, ...now.map((row) => row[1 + pad] ?? 0)));
  const points = now.some((row) => row.length > 22) ? Array.from({length: 16}, (_, at) => Math.max(0, ...now.map((row) => row[22 + at] ?? 0))) : null;
  return {largest, peak, points};
}

function age() {
  return state.heard ? (state.news.age ?? 0) + (performance.now() - state.heard) / 1e3 : Infinity;
}

function show() {
  showHealth();
  if (!state.facts || document.hidden || !state.changed) return;
  state.changed = false;
  const {facts, motion} = state;
  by("title").textContent = `plow_twin · ${facts.head}`;
  by("source").textContent = `scene ${facts.scene} · ${facts.source}`;
  showAlarms();
  showEvents();
  showInputs();
  if (!motion) return;
  by("stamp").textContent = moment(motion.t);
  const {largest, peak, points} = extremes();
  const wear = facts.pads.map((pad) => motion.clearance?.[`pad_${pad.name}`] ?? 0);
  section.draw(motion, peak, wear, Math.max(...largest));
  by("section-note").textContent = `Seen from the front; gaps drawn ${section.factor.toFixed(0)} times as wide. Outer stripe and number: peak force of the last second [kN]; inner stripe: wear. Orange: walls in contact.`;
  showPads(peak, largest, wear, points);
  showClearance();
  const [fx, fy, m] = motion.load;
  by("load").textContent = facts.loads ? `Fx ${kilo(fx)} kN, Fy ${kilo(fy)} kN, M ${kilo(m)} kN m${motion.held ? " (held: no samples arrive)" : ""}` : "loads of the scene";
  by("load").className = motion.held ? "warn" : "";
}

function showHealth() {
  const old = age(), banner = by("banner");
  const said = state.closed || (old > OLD_S && state.facts ? `no update from the twin for ${old.toFixed(0)} s: the values shown are old` : "");
  banner.hidden = !said;
  banner.textContent = said;
  by("main").classList.toggle("old", Boolean(said));
  by("connection").textContent = state.closed ? "not connected" : "connected";
  by("connection").className = `pill ${said ? "error" : ""}`;
  const [level, message, status] = part("status");
  by("stream").textContent = status.stream || message || "waiting";
  by("stream").title = message;
  by("stream").className = `pill ${CLASSES[level] ?? "error"}`;
  const can = Boolean(state.facts?.can_ask) && !said;
  by("acknowledge").disabled = by("mark").querySelector("button").disabled = !can;
  const {pages = 0, not_taken = 0, skipped = 0} = state.news;
  by("footer").textContent = `pages open: ${pages}; updates without room: ${not_taken}; skipped by this page: ${skipped}`;
}

function showAlarms() {
  const found = values("alarms");
  const names = Object.keys(found).filter((name) => `${name}_level` in found);
  rows("alarms", names.map((name) => {
    const [unit, factor, digits] = UNITS[name] ?? ["", 1, 3];
    const level = found[`${name}_level`], latched = found[`${name}_latched`];
    const worst = Math.max(...[level, latched].map((text) => ["none", "warn", "error"].indexOf(text)));
    const thresholds = (state.facts.thresholds[name] ?? []).map((value) => (value > 0 ? fixed(value * factor, digits) : "–"));
    const text = level === "none" ? (latched === "none" ? "none" : `was ${latched}`) : level;
    const raised = (key) => found[`${name}_${key}`] ?? "";
    const value = raised("raised") === "" ? found[name] : raised("raised");
    const place = raised("place");
    return [
      [name.replaceAll("_", " "), CLASSES[worst]], [`${fixed(value * factor, digits)} ${unit}`, "n"],
      [place.replaceAll("_", " "), ""],
      [raised("threshold") === "" ? thresholds.join(" / ") : fixed(raised("threshold") * factor, digits), "n"],
      [raised("stamp_ns") === "" ? "" : clock(Number(raised("stamp_ns")) * 1e-9), ""], [text, CLASSES[worst]],
    ];
  }));
}

function showPads(peak, largest, wear, points) {
  const {facts, motion} = state, limits = facts.thresholds.force ?? [0, 0], window = values("window_forces");
  const scale = Math.max(...largest, ...limits, 1);
  const body = by("pads").tBodies[0];
  body.replaceChildren();
  facts.pads.forEach((pad, index) => {
    const row = body.insertRow();
    cell(row, `${pad.corner ? `${pad.corner} ` : ""}${padName(pad.name)}`);
    const bar = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    bar.setAttribute("class", "bar");
    bar.setAttribute("viewBox", "0 0 100 10");
    bar.setAttribute("preserveAspectRatio", "none");
    const put = (name, attributes) => {
      const found = document.createElementNS("http://www.w3.org/2000/svg", name);
      for (const [key, value] of Object.entries(attributes)) found.setAttribute(key, value);
      bar.append(found);
    };
    const line = (value, kind, color) => put("line", {x1: 98 * value / scale, x2: 98 * value / scale, y1: 0, y2: 10, class: kind, "vector-effect": "non-scaling-stroke", ...(color ? {stroke: color} : {})});
    put("rect", {class: "back", x: 0, y: 0, width: 100, height: 10});
    put("rect", {x: 0, y: 1, width: 98 * peak[index] / scale, height: 8, fill: forceColor(peak[index], limits, Math.max(...largest))});
    line(largest[index], "largest");
    limits.forEach((limit, at) => { if (limit > 0) line(limit, "limit", at ? "#c8001e" : "#e69f00"); });
    const [low, high] = points ? [points[index], points[8 + index]] : ["p05", "p95"].map((point) => Number(window[`${pad.name}/${point}`]));
    if (high > 0) put("line", {class: "interval", x1: 98 * low / scale, x2: Math.min(100, 98 * high / scale), y1: 5, y2: 5, "vector-effect": "non-scaling-stroke"});
    row.insertCell().append(bar);
    const over = limits[1] > 0 && peak[index] >= limits[1] ? "error" : limits[0] > 0 && peak[index] >= limits[0] ? "warn" : "";
    cell(row, kilo(peak[index]), `n ${over}`);
    cell(row, kilo(largest[index]), "n");
    const worn = cell(row, depth(wear[index]), "n");
    const bounds = ["p05", "p95"].map((point) => motion.clearance?.[`pad_${pad.name}/${point}`]);
    worn.title = `5 % and 95 % points: ${bounds.map(depth).join(" to ")}`;
    worn.style.boxShadow = `inset -4px 0 ${wearColor(wear[index], Math.max(...wear, 1e-6))}`;
  });
  const set = limits.some((limit) => limit > 0);
  by("pads-note").textContent = `Vertical stroke: largest force in the time span. ${set ? "Amber and red: thresholds of warning and error." : "No threshold is set (parameter alarm_force)."}` +
    (points ? " Thin line: 5 % to 95 % interval of the peak, given the measurements." :
      Object.keys(window).length ? " Thin line: 5 % to 95 % interval of the peak in the last estimated window." : "");
}

function showClearance() {
  const {motion, facts} = state, status = values("status");
  const line = (name) => {
    const [value, low, high] = ["", "/p05", "/p95"].map((point) => motion.clearance?.[`${name}${point}`]);
    const millimetre = (metre) => fixed(metre === undefined ? null : metre * 1e3, 3);
    return [[name, ""], [`${millimetre(value)} mm`, "n"], [`${millimetre(low)} to ${millimetre(high)}`, "n"], [SOURCES[status[name]] ?? "", ""]];
  };
  rows("clearance", ["horizontal", "vertical"].map(line));
  by("life").textContent = life(values("forecast"), "forecast" in state.parts, facts.limits);
}

function life(found, known, limits) {
  if (!limits.some((limit) => limit > 0)) return "Remaining life: no limit is set (parameter forecast_limits).";
  if (!known) return "Remaining life: not known before the first estimate.";
  if (!Object.keys(found).length) return "Remaining life: withdrawn with the estimate.";
  const hours = (point) => (found[`seconds/${point}`] === undefined ? "beyond the horizon" : `${fixed(found[`seconds/${point}`] / 3600, 0)} h`);
  const beyond = found.not_reached_in_horizon === undefined ? "" : `, ${fixed(100 * found.not_reached_in_horizon, 0)} % beyond the horizon`;
  const shifts = found["shifts/p50"] === undefined ? "" : `; ${fixed(found["shifts/p50"], 0)} shifts`;
  return `Remaining life of operation to the limits ${limits.map((limit) => fixed(limit * 1e3, 1)).join(" and ")} mm: ${hours("p50")} (10 % to 90 %: ${hours("p10")} to ${hours("p90")}${beyond})${shifts}. It follows from the estimate and the prior of the wear.`;
}

function showInputs() {
  const input = values("input"), status = values("status"), output = values("output");
  const silent = (status.stale_inputs ?? "").split(",");
  const sum = (pattern) => Object.entries(input).reduce((all, [key, value]) => all + (pattern.test(key) ? Number(value) : 0), 0);
  const about = (name) => (silent.includes(name) ? ["silent", "warn"] : Number(status[`publishers_${name}`] ?? 0) ? ["connected", ""] : ["not connected", ""]);
  const dropped = sum(/^dropped_/), lost = Number(input.samples_lost ?? 0) + Number(input.samples_missing ?? 0);
  const number = (count) => [String(count), Number(count) ? "n warn" : "n"];
  const source = input.source ?? "excitation";
  const lines = [[[source, ""], [input.samples_used ?? "–", "n"], number(dropped), number(lost), about(source)]];
  for (const name of ["travel", "head_pose", "gaps"]) {
    if (Number(status[`publishers_${name}`] ?? 0) || Number(input[`${name}_used`] ?? 0)) {
      lines.push([[name.replace("_", " "), ""], [input[`${name}_used`] ?? "–", "n"], number(input[`${name}_dropped`] ?? 0), ["", ""], about(name)]);
    }
  }
  rows("inputs", lines);
  const told = [
    input.newest_sample_age_s ? `age of the newest sample ${input.newest_sample_age_s} s` : "",
    output.held && output.held !== "0" ? `held: ${output.held} publications` : "",
    output.recent_latency_p99_ms ? `latency (99 %) ${output.recent_latency_p99_ms} ms` : "",
    Number(input.messages_lost ?? 0) ? `messages lost: ${input.messages_lost}` : "",
    values("state").solver_failures > 0 ? `failed advances: ${values("state").solver_failures}` : "",
    status.follow && status.follow !== "off" ? `the twin follows the machine (values of the ${status.follow})` : "",
    status.recorder && status.recorder !== "off" ? `recorder: ${status.recorder}` : "not recorded",
    LEVELS[part("input")[0]] !== "OK" ? part("input")[1] : "",
  ];
  by("health").textContent = told.filter(Boolean).join("; ");
}

function showEvents() {
  by("events").replaceChildren(...state.events.slice(-30).reverse().map((event) => {
    const item = document.createElement("li");
    item.className = event.done ? "" : "warn";
    item.textContent = `${clock(event.t)}  ${event.kind}${event.done ? "" : " refused"}: ${event.text}`;
    return item;
  }));
}

by("acknowledge").onclick = () => wish("acknowledge");
by("mark").onsubmit = (event) => {
  event.preventDefault();
  wish("mark", by("mark-text").value.trim() || "screen");
  by("mark-text").value = "";
};
by("door").onsubmit = (event) => {
  event.preventDefault();
  token.value = by("token").value;
  sessionStorage.setItem("token", token.value);
  by("door").hidden = true;
  connect();
};
by("window").onchange = () => { state.changed = true; charts?.draw(state, Number(by("window").value)); };
setInterval(show, 200);
setInterval(() => { if (!document.hidden && state.motion) charts?.draw(state, Number(by("window").value)); }, 1000);
window.screenState = state;
connect();
