// Draws the cross-section as SVG. It shows the frame, the head with widened gaps, the pads and the load.

const SVG = "http://www.w3.org/2000/svg";
const MM = 1000;

function add(parent, name, attributes) {
  const found = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) found.setAttribute(key, value);
  parent.append(found);
  return found;
}

const mixed = (from, to, share) => {
  const part = Math.min(1, Math.max(0, share));
  return `rgb(${from.map((value, index) => Math.round(value + part * (to[index] - value))).join(" ")})`;
};
const CALM = [150, 160, 168], BLUE = [0, 114, 178], AMBER = [230, 159, 0], RED = [200, 0, 30], PURPLE = [88, 40, 150];

// Returns the colour of a force [N]. The colour changes from grey at 0 to amber at the warning threshold, and is red
// above the error threshold. If there are no thresholds, it changes from grey at 0 to blue at the force `largest`.
export function forceColor(force, [warn, error], largest) {
  if (error > 0 && force >= error) return mixed(RED, RED, 1);
  if (warn > 0 && force >= warn) return mixed(AMBER, AMBER, 1);
  const limit = warn || error;
  return limit > 0 ? mixed(CALM, AMBER, 0.6 * force / limit) : mixed(CALM, BLUE, largest > 0 ? force / largest : 0);
}

export const wearColor = (depth, largest) => mixed([205, 210, 214], PURPLE, largest > 0 ? depth / largest : 0);

// Walls in the order top, right, bottom, left. A wall is given by the indices of the two pads at its ends.
const WALLS = [[0, 2], [3, 5], [4, 6], [7, 1]];

// Returns the intersection of two lines. A line is given by two points.
function crossing([[ax, ay], [bx, by]], [[cx, cy], [dx, dy]]) {
  const [ux, uy, vx, vy] = [bx - ax, by - ay, dx - cx, dy - cy];
  const share = ((cx - ax) * vy - (cy - ay) * vx) / (ux * vy - uy * vx);
  return [ax + share * ux, ay + share * uy];
}

export class Section {
  constructor(svg, facts) {
    this.svg = svg;
    svg.replaceChildren();
    this.facts = facts;
    const [width, height] = this.half = facts.frame.map((side) => 0.5 * MM * side);
    const small = Math.min(width, height);
    const gap = MM * Math.max(...facts.clearance);
    // the factor is chosen so that the clearance fills a third of the smaller side of the frame
    this.factor = gap > 0 ? Math.max(1, 2 * small / 3 / gap) : 1;
    const [w, h] = [width, height].map((side) => side + 0.62 * small);
    svg.setAttribute("viewBox", `${-w} ${-h} ${2 * w} ${2 * h}`);
    // letters and strokes have a constant size on the screen
    this.unit = 2 * Math.max(w, h) / 520;
    add(svg, "rect", {class: "frame", x: -width, y: -height, width: 2 * width, height: 2 * height, "vector-effect": "non-scaling-stroke"});
    this.head = add(svg, "polygon", {class: "head", "vector-effect": "non-scaling-stroke"});
    this.walls = WALLS.map(() => add(svg, "line", {class: "wall", "vector-effect": "non-scaling-stroke"}));
    this.pads = facts.pads.map((pad) => this.pad(pad, small));
    this.load = add(svg, "path", {class: "load", "vector-effect": "non-scaling-stroke"});
    this.loadText = this.text("", 0, 0);
    for (const pad of facts.pads.filter((_, index) => index % 2 === 0)) {
      if (pad.corner) this.text(pad.corner, (width - 0.62 * small) * pad.at[0], -(height - 0.62 * small) * pad.at[1], "letter");
    }
  }

  text(content, x, y, kind = "") {
    const found = add(this.svg, "text", {x, y, class: kind});
    found.style.fontSize = `${(kind ? 22 : 17) * this.unit}px`;
    found.textContent = content;
    return found;
  }

  // A pad is drawn inside the frame along its wall, beginning at the corner. The outer stripe shows the force, and the
  // inner stripe shows the wear.
  pad(pad, small) {
    const [length, depth] = [0.42 * small, 0.075 * small];
    const stripe = (from) => {
      const [x0, y0] = pad.at.map((sign, axis) => sign * this.half[axis]);
      const along = pad.at.map((sign, axis) => sign - pad.normal[axis]);
      const corners = [[0.12, from], [0.12 + length / small, from + 1]].map(([a, d]) => [
        x0 - along[0] * a * small - pad.normal[0] * d * depth, y0 - along[1] * a * small - pad.normal[1] * d * depth]);
      const xs = corners.map((corner) => corner[0]), ys = corners.map((corner) => -corner[1]);
      return add(this.svg, "rect", {class: "pad", x: Math.min(...xs), y: Math.min(...ys), width: Math.abs(xs[0] - xs[1]), height: Math.abs(ys[0] - ys[1]), "vector-effect": "non-scaling-stroke"});
    };
    const force = stripe(0), wear = stripe(1);
    // the number is placed beyond the end of a horizontal pad, or beside a vertical pad
    const [dx, dy] = pad.normal[0] ? [0.21, 0.33] : [0.78, 0.1];
    const text = this.text("", pad.at[0] * (this.half[0] - dx * small), -pad.at[1] * (this.half[1] - dy * small));
    if (pad.normal[0]) text.style.textAnchor = pad.normal[0] > 0 ? "end" : "start";
    add(force, "title", {});
    return {force, wear, text};
  }

  // Draws `peak` [N] and `wear` [m] of each pad; `largest` is the largest force [N] in the selected time span.
  draw(motion, peak, wear, largest) {
    const {facts, half} = this;
    const deepest = Math.max(...wear, 1e-6);
    this.pads.forEach((pad, index) => {
      pad.force.setAttribute("fill", forceColor(peak[index], facts.thresholds.force ?? [0, 0], largest));
      pad.wear.setAttribute("fill", wearColor(wear[index], deepest));
      pad.text.textContent = peak[index] >= 500 ? `${(peak[index] / 1e3).toFixed(0)}` : "";
      pad.force.firstChild.textContent = facts.pads[index].name;
    });
    const ends = facts.pads.map((pad, index) => pad.at.map((sign, axis) =>
      sign * half[axis] - pad.normal[axis] * MM * this.factor * (motion.penetration[index] ?? 0)));
    const lines = WALLS.map((wall) => wall.map((pad) => ends[pad]));
    const corners = lines.map((line, index) => crossing(lines[(index + 3) % 4], line));
    this.head.setAttribute("points", corners.map(([x, y]) => `${x},${-y}`).join(" "));
    this.walls.forEach((wall, index) => {
      const [[x1, y1], [x2, y2]] = [corners[index], corners[(index + 1) % 4]];
      for (const [key, value] of Object.entries({x1, y1: -y1, x2, y2: -y2})) wall.setAttribute(key, value);
      wall.classList.toggle("touches", WALLS[index].some((pad) => (motion.penetration[pad] ?? -1) > 0));
    });
    this.drawLoad(motion.load);
  }

  drawLoad([fx, fy]) {
    const size = Math.hypot(fx ?? 0, fy ?? 0);
    this.largestLoad = Math.max(this.largestLoad ?? 1, size);
    const length = 0.33 * Math.min(...this.half) / this.largestLoad;
    const [x, y] = [(fx ?? 0) * length, -(fy ?? 0) * length];
    const [ux, uy] = size > 0 ? [x / Math.hypot(x, y), y / Math.hypot(x, y)] : [0, 0];
    const tip = 9 * this.unit;
    const wing = (side) => `${x - tip * (ux + side * 0.6 * uy)} ${y - tip * (uy - side * 0.6 * ux)}`;
    this.load.setAttribute("d", size > 0 ? `M0 0L${x} ${y}M${wing(1)}L${x} ${y}L${wing(-1)}` : "");
    this.loadText.textContent = size > 0 ? `load ${(size / 1e3).toFixed(0)} kN` : "";
    this.loadText.setAttribute("y", (y > 0 ? -1 : 1) * 16 * this.unit);
  }
}
