// Draws charts of the selected time span. They show the peaks of the pads, the clearances with their intervals, and
// the extremes of the load.

/* global uPlot */
const COLORS = ["#0072b2", "#56b4e9", "#e69f00", "#b8a600", "#d55e00", "#ff9e69", "#009e73", "#6edcb9"];
const HEIGHT = 170;
const clock = (seconds) => new Date(seconds * 1e3).toLocaleTimeString("en-GB");
const ink = () => getComputedStyle(document.documentElement).getPropertyValue("--ink");
const grid = () => getComputedStyle(document.documentElement).getPropertyValue("--line");
const faded = (color) => `${color}33`;

// Returns columns of numbers. The first column contains the time of each second. Each column after the first contains
// values that `read` returns for the seconds. Missing seconds interrupt a line.
function columns(seconds, count, read) {
  const found = Array.from({length: count + 1}, () => []);
  let before = null;
  for (const row of seconds) {
    if (before !== null && row[0] > before + 2 && found[0].length) found.forEach((column, index) => column.push(index ? null : before + 1));
    [row[0], ...read(row)].forEach((value, index) => found[index].push(value ?? null));
    before = row[0];
  }
  return found;
}

const scaled = (row, from, to, factor) => row.slice(from, to).map((value) => (value === null ? null : value * factor));

export class Charts {
  constructor(facts) {
    this.facts = facts;
    this.plots = null;
    this.resize = () => this.plots?.forEach((plot) => plot.setSize({width: this.width(), height: HEIGHT}));
    addEventListener("resize", this.resize);
  }

  width() {
    return Math.max(280, document.getElementById("force-chart").clientWidth);
  }

  destroy() {
    removeEventListener("resize", this.resize);
    this.plots?.forEach((plot) => plot.destroy());
  }

  make(id, title, series, dated, more = {}) {
    const axis = {stroke: ink, grid: {stroke: grid, width: 1}, ticks: {stroke: grid}};
    return new uPlot({
      title, width: this.width(), height: HEIGHT, series: [{label: "time", value: (_, at) => (at === null ? "" : dated ? clock(at) : `${at} s`)}, ...series],
      scales: {x: {time: dated}}, axes: [{...axis, size: 36, ...(dated ? {space: 80, values: (_, at) => at.map(clock)} : {values: (_, at) => at.map((second) => `${second} s`)})}, {...axis, size: 60}],
      padding: [null, 34, 0, 0],
      cursor: {drag: {x: false, y: false}, sync: {key: "screen"}},
      hooks: {drawClear: [(plot) => this.shade(plot)], draw: [(plot) => this.rule(plot, more.limits ?? [])]},
      ...more.options,
    }, [[0]], document.getElementById(id));
  }

  start(dated) {
    const line = (label, color, more = {}) => ({label, stroke: color, width: 1.2, points: {show: false}, ...more});
    const bound = (label, color) => line(label, faded(color), {width: 0.5});
    const pads = this.facts.pads.map((pad, index) => line(pad.name.replaceAll("_", " "), COLORS[index]));
    const axes = [["horizontal", COLORS[0]], ["vertical", COLORS[4]]];
    const intervals = axes.flatMap(([name, color]) => [line(name, color, {width: 2}), bound(`${name} 5 %`, color), bound(`${name} 95 %`, color)]);
    const loads = [["Fx", COLORS[0]], ["Fy", COLORS[4]], ["M", COLORS[6]]];
    const extremes = [...loads.map(([name, color]) => line(`${name} least`, color)), ...loads.map(([name, color]) => line(`${name} largest`, color))];
    const band = (high, low, color) => ({series: [high, low], fill: faded(color)});
    this.plots = [
      this.make("force-chart", "Peak force of each pad in a second [kN]", pads, dated, {limits: this.facts.thresholds.force ?? []}),
      this.make("clearance-chart", "Clearance with its 5 % to 95 % interval [mm]", intervals, dated, {options: {bands: [band(3, 2, COLORS[0]), band(6, 5, COLORS[4])]}}),
      this.make("load-chart", "Load: least and largest in a second [kN, kN m]", extremes, dated, {options: {bands: loads.map(([, color], index) => band(4 + index, 1 + index, color))}}),
    ];
  }

  draw(state, span) {
    const {seconds} = state;
    if (!seconds.length) return;
    if (!this.plots) this.start(seconds.at(-1)[0] > 1e9);
    this.seconds = seconds;
    this.events = state.events;
    const end = seconds.at(-1)[0], shown = seconds.filter((row) => row[0] >= end - span);
    const data = [
      columns(shown, 8, (row) => scaled(row, 1, 9, 1e-3)),
      columns(shown, 6, (row) => scaled(row, 15, 21, 1e3)),
      columns(shown, 6, (row) => scaled(row, 9, 15, 1e-3)),
    ];
    this.plots.forEach((plot, index) => {
      plot.setData(data[index], false);
      plot.batch(() => {
        plot.setScale("x", {min: Math.max(end - span, shown[0][0] - 1), max: end + 1});
        const numbers = data[index].slice(1).flat().filter((value) => value !== null);
        const low = Math.min(...numbers), high = Math.max(...numbers), room = 0.05 * (high - low) || 0.05 * Math.abs(high) || 1;
        plot.setScale("y", {min: index === 0 ? 0 : low - room, max: high + room});
      });
    });
  }

  // Draws in grey the seconds in which the load was held.
  shade(plot) {
    plot.ctx.save();
    plot.ctx.fillStyle = "#80808040";
    for (const row of this.seconds ?? []) {
      if (row[21] && row[0] >= plot.scales.x.min) {
        const left = plot.valToPos(row[0], "x", true), right = plot.valToPos(row[0] + 1, "x", true);
        plot.ctx.fillRect(left, plot.bbox.top, right - left, plot.bbox.height);
      }
    }
    plot.ctx.restore();
  }

  // Draws thresholds as horizontal lines, and marks and acknowledgements as vertical lines.
  rule(plot, limits) {
    const {ctx, bbox} = plot;
    ctx.save();
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    ctx.setLineDash([6, 4]);
    const line = (color, x1, y1, x2, y2) => {
      ctx.strokeStyle = color;
      ctx.beginPath();
      ctx.moveTo(x1, y1);
      ctx.lineTo(x2, y2);
      ctx.stroke();
    };
    limits.forEach((limit, at) => {
      const y = plot.valToPos(limit / 1e3, "y", true);
      if (limit > 0) line(at ? "#c8001e" : "#e69f00", bbox.left, y, bbox.left + bbox.width, y);
    });
    let before = -Infinity, row = 0;
    for (const event of (this.events ?? []).filter((one) => one.done && one.t >= plot.scales.x.min)) {
      const x = plot.valToPos(event.t, "x", true);
      line("#b04a8c", x, bbox.top, x, bbox.top + bbox.height);
      ctx.fillStyle = "#b04a8c";
      ctx.textAlign = "right";
      const text = event.kind === "mark" ? event.text.split(": ")[0].slice(0, 24) : event.kind;
      const width = ctx.measureText(text).width;
      const end = Math.max(x - 4, bbox.left + 4 + width);
      row = end - width < before ? (row + 1) % 5 : 0;
      before = Math.max(x, end);
      ctx.fillText(text, end, bbox.top + 12 + 12 * row);
    }
    ctx.restore();
  }
}
