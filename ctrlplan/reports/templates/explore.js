const NS = "http://www.w3.org/2000/svg", COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00"];
const STYLE = `
.ctrlplan-explore { display: flex; flex-wrap: wrap; gap: 1rem; align-items: flex-start; }
.ctrlplan-explore .sliders { flex: 0 1 18rem; }
.ctrlplan-explore label { display: grid; grid-template-columns: 4.5rem 1fr 4.5rem; gap: .4rem; align-items: center; }
.ctrlplan-explore output { text-align: right; font-variant-numeric: tabular-nums; }
.ctrlplan-explore .drawings { flex: 1 1 22rem; display: grid; grid-template-columns: repeat(auto-fill, minmax(20rem, 1fr)); gap: .6rem; }
.ctrlplan-explore svg { width: 100%; height: auto; color: inherit; font: 11px sans-serif; }
.ctrlplan-explore .error { color: #b00020; }
.ctrlplan-explore td:nth-child(2) { text-align: right; padding: 0 .4rem 0 1rem; }
@media (prefers-color-scheme: dark) { .ctrlplan-explore .error { color: #ff8a80; } }
`;

function make(parent, tag, attributes, text) {
  const element = tag === "svg" || parent.namespaceURI === NS ? document.createElementNS(NS, tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(attributes || {})) { element.setAttribute(name, value); }
  if (text !== undefined) { element.textContent = text; }
  parent.appendChild(element);
  return element;
}

function shown(value) {
  return String(Number(value.toPrecision(4))).replace("-", "\u2212");
}

function ticks(low, high) {
  const raw = (high - low) / 2.5, unit = Math.pow(10, Math.floor(Math.log10(raw)));
  const step = [5, 2, 1].find((factor) => factor * unit <= raw * (1 + 1e-9)) * unit, found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k += 1) { found.push(k * step); }
  return found;
}

function range(values) {
  let low = Infinity, high = -Infinity;
  for (const value of values) {
    if (Number.isFinite(value)) { low = Math.min(low, value); high = Math.max(high, value); }
  }
  if (low > high) { return [0, 1]; }
  const margin = high > low ? 0.05 * (high - low) : 0.5 * Math.abs(high) || 0.5;
  return [low - margin, high + margin];
}

function draw(parent, panel, row) {
  const box = [52, 8, 300, 150], [left, top, width, height] = box;
  const svg = make(parent, "svg", { viewBox: "0 0 360 200", role: "img", "aria-label": `${panel.title} over ${panel.across}` });
  const all = (which) => panel.curves.flatMap((curve) => Array.from(row(curve[which])));
  let across = range(all(1).concat(panel.points.map((point) => point[0]))), up = range(all(2).concat(panel.points.map((point) => point[1])));
  if (panel.equal) {
    const scale = Math.max((across[1] - across[0]) / width, (up[1] - up[0]) / height);
    const wide = (pair, size) => { const middle = (pair[0] + pair[1]) / 2; return [middle - scale * size / 2, middle + scale * size / 2]; };
    across = wide(across, width);
    up = wide(up, height);
  }
  const x = (value) => left + (value - across[0]) / (across[1] - across[0]) * width;
  const y = (value) => top + height - (value - up[0]) / (up[1] - up[0]) * height;
  make(svg, "rect", { x: left, y: top, width: width, height: height, fill: "none", stroke: "currentColor", "stroke-opacity": .4 });
  for (const value of ticks(...across)) {
    make(svg, "line", { x1: x(value), x2: x(value), y1: top, y2: top + height, stroke: "currentColor", "stroke-opacity": .12 });
    make(svg, "text", { class: "tick-x", "data-value": value, x: x(value), y: top + height + 13, "text-anchor": "middle", fill: "currentColor" }, shown(value));
  }
  for (const value of ticks(...up)) {
    make(svg, "line", { x1: left, x2: left + width, y1: y(value), y2: y(value), stroke: "currentColor", "stroke-opacity": .12 });
    make(svg, "text", { class: "tick-y", "data-value": value, x: left - 4, y: y(value), dy: ".35em", "text-anchor": "end", fill: "currentColor" }, shown(value));
  }
  make(svg, "text", { x: left + width / 2, y: 194, "text-anchor": "middle", fill: "currentColor" }, panel.across);
  make(svg, "text", { x: -(top + height / 2), y: 11, transform: "rotate(-90)", "text-anchor": "middle", fill: "currentColor" }, panel.title);
  panel.curves.forEach((curve, k) => {
    const xs = row(curve[1]), ys = row(curve[2]), colour = COLOURS[k % COLOURS.length];
    let path = "", started = false;
    for (let i = 0; i < xs.length; i += 1) {
      if (!Number.isFinite(xs[i]) || !Number.isFinite(ys[i])) { started = false; continue; }
      path += `${started ? "L" : "M"}${x(xs[i]).toFixed(2)} ${y(ys[i]).toFixed(2)}`;
      started = true;
    }
    make(svg, "path", { d: path, "data-name": curve[0], fill: "none", stroke: colour, "stroke-width": 1.6, "stroke-dasharray": curve[0].startsWith("response") ? "5 3" : "none" });
    if (panel.curves.length > 1) {
      make(svg, "text", { x: left + 6, y: top + 13 + 13 * k, fill: colour }, curve[0]);
    }
  });
  for (const point of panel.points) {
    make(svg, "circle", { cx: x(point[0]), cy: y(point[1]), r: 3, fill: "none", stroke: "currentColor" });
  }
}

function render({ model, el }) {
  make(el, "style", {}, STYLE);
  const root = make(el, "div", { class: "ctrlplan-explore" }), controls = make(root, "div", { class: "sliders" });
  const drawings = make(root, "div", { class: "drawings" }), groups = {}, inputs = {};
  let waiting = false, changed = false;
  function send() {
    if (waiting) { changed = true; return; }
    changed = false;
    const values = Object.fromEntries(Object.entries(inputs).map(([key, [input]]) => [key, Number(input.value)])), known = model.get("values");
    if (Object.keys(values).every((key) => values[key] === known[key])) { return; }
    waiting = true;
    model.set("values", values);
    model.save_changes();
  }
  for (const slider of model.get("sliders")) {
    if (!groups[slider.group]) {
      const fold = make(controls, "details", Object.keys(groups).length < 3 ? { open: "" } : {});
      make(fold, "summary", {}, slider.group);
      groups[slider.group] = fold;
    }
    const label = make(groups[slider.group], "label");
    make(label, "span", {}, slider.key.replace(/\[\d+\]/, ""));
    const input = make(label, "input", { type: "range", name: slider.key, min: slider.low, max: slider.high, step: "any" });
    const output = make(label, "output");
    input.value = slider.value;
    input.addEventListener("input", () => { output.textContent = shown(Number(input.value)); send(); });
    inputs[slider.key] = [input, output];
  }
  const table = make(controls, "table"), error = make(controls, "p", { class: "error", role: "alert" });
  function update() {
    const values = model.get("values"), bytes = model.get("numbers");
    if (!changed) {
      for (const [key, [input, output]] of Object.entries(inputs)) {
        const value = key in values ? values[key] : Number(input.value);
        input.min = Math.min(input.min, value);
        input.max = Math.max(input.max, value);
        input.value = value;
        output.textContent = shown(value);
      }
    }
    error.textContent = model.get("error");
    drawings.style.opacity = model.get("error") ? .35 : 1;
    const rows = model.get("scene").flatMap((panel) => panel.curves.flatMap((curve) => [curve[1], curve[2]]));
    const count = bytes.byteLength / 4, length = model.get("length"), view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    const row = (k) => Array.from({ length: length }, (_, i) => view.getFloat32(4 * (k * length + i), true));
    if (rows.some((k) => (k + 1) * length > count)) { return; }
    drawings.replaceChildren();
    model.get("scene").forEach((panel) => draw(drawings, panel, row));
    table.replaceChildren();
    for (const cells of model.get("table")) {
      const line = make(table, "tr");
      cells.forEach((cell) => make(line, "td", {}, cell));
    }
  }
  function answered() {
    update();
    waiting = false;
    if (changed) { send(); }
  }
  model.on("change:count", answered);
  update();
  return () => model.off("change:count", answered);
}

export default { render };
