// The live page: what comes down the stream, drawn on canvases. No library: at a phone's width and a quarter of this
// machine's speed plotly's script takes 11 s to load and 280 ms for an update; these charts take 1 ms.
"use strict";

const byId = (id) => document.getElementById(id);
const store = { readings: [], estimates: [], bin_ms: 1 }; // cells of the stream, oldest first
const shown = { status: null, allan: null, histogram: null, zoom: null, paused: false, pointer: null };
let stream = null;
let colours = {};
let redrawAsked = false;

// -- the stream ------------------------------------------------------------------------------------------------------

const spanS = () => Number(byId("span").value);

function chartColumns() {
  return Math.round(Math.min(4000, Math.max(64, 1.5 * byId("chart-input").clientWidth)));
}

function connect() {
  disconnect();
  stream = new EventSource(`stream?span_s=${spanS()}&columns=${chartColumns()}`);
  stream.onmessage = (message) => take(JSON.parse(message.data));
  stream.onerror = () => setState("reconnecting");
}

function disconnect() {
  if (stream) stream.close();
  stream = null;
}

function take(frame) {
  if (frame.fresh) {
    store.readings = [];
    store.estimates = [];
  }
  store.bin_ms = frame.bin_ms;
  append(store.readings, frame.readings, frame.bin_ms);
  append(store.estimates, frame.estimates, frame.bin_ms);
  const begin = newest() - 1e3 * spanS() - 2 * frame.bin_ms;
  for (const cells of [store.readings, store.estimates]) {
    let old = 0;
    while (old < cells.length && cells[old].t < begin) old += 1;
    cells.splice(0, old);
  }
  if (frame.status) {
    Object.assign(shown, { status: frame.status, allan: frame.allan, histogram: frame.histogram });
    showStatus();
  }
  if (shown.status) showNow(frame.now);
  redraw();
}

function append(cells, columns, bin_ms) {
  const names = Object.keys(columns);
  for (let row = 0; row < columns.n.length; row += 1) {
    const cell = { t: (columns.n[row] + 0.5) * bin_ms };
    for (const name of names) cell[name] = columns[name][row];
    if (cells.length && cells[cells.length - 1].n === cell.n) cells.pop(); // the newest bin has got more
    cells.push(cell);
  }
}

function newest() {
  const last = (cells) => (cells.length ? cells[cells.length - 1].t : 0);
  return Math.max(last(store.readings), last(store.estimates)) + 0.5 * store.bin_ms;
}

// -- numbers ---------------------------------------------------------------------------------------------------------

const scale = (volts) => (volts === null ? null : shown.status.offset + shown.status.factor * volts);
const stretch = (volts) => (volts === null ? null : shown.status.factor * volts);
const unit = () => (shown.status ? shown.status.unit : "V");

function prefixFor(size) {
  if (unit() !== "V" || !(size > 0)) return [1, unit()];
  const power = Math.max(-4, Math.min(0, Math.floor(Math.log10(size) / 3 + 1e-9)));
  return [1000 ** power, ["", "m", "µ", "n", "p"][-power] + unit()];
}

function withSign(value, decimals) {
  return (value < 0 ? "−" : "+") + Math.abs(value).toFixed(decimals);
}

function quantity(value, digits = 5) {
  if (value === null || value === undefined) return "no value";
  const [size, name] = prefixFor(Math.abs(value));
  const scaled = value / size;
  const whole = scaled === 0 ? 1 : Math.max(1, Math.floor(Math.log10(Math.abs(scaled))) + 1);
  return `${withSign(scaled, Math.max(0, digits - whole))} ${name}`;
}

// To the last digit of the meter's own display.
function atMeterDigits(value) {
  if (value === null) return "no value";
  const digit = Math.abs(shown.status.factor) * shown.status.resolution_V;
  if (!(digit > 0)) return quantity(value, 7);
  const [size, name] = prefixFor(Math.abs(value));
  return `${withSign(value / size, Math.min(12, Math.max(0, Math.ceil(-Math.log10(digit / size) - 1e-9))))} ${name}`;
}

function bytes(count) {
  const power = count > 0 ? Math.min(4, Math.floor(Math.log10(count) / 3)) : 0;
  return `${(count / 1000 ** power).toFixed(power ? 1 : 0)} ${["B", "kB", "MB", "GB", "TB"][power]}`;
}

function duration(seconds) {
  const whole = Math.floor(seconds);
  const [days, hours, minutes] = [Math.floor(whole / 86400), Math.floor(whole / 3600) % 24, Math.floor(whole / 60) % 60];
  const two = (number) => String(number).padStart(2, "0");
  return `${days ? `${days} d ` : ""}${two(hours)}:${two(minutes)}:${two(whole % 60)}`;
}

function clockTime(t_ms, decimals = 0) {
  const at = new Date(t_ms);
  const text = at.toTimeString().slice(0, 8);
  return decimals ? `${text}.${String(at.getMilliseconds()).padStart(3, "0").slice(0, decimals)}` : text;
}

function setText(id, text) {
  if (byId(id).textContent !== text) byId(id).textContent = text;
}

function showNow(now) {
  const reading = byId("reading");
  setText("reading", atMeterDigits(scale(now.value_V)));
  reading.dataset.valueV = now.value_V;
  reading.dataset.index = now.index;
  setText("index", now.index < 0 ? "" : `no. ${now.index.toLocaleString("en")} · ${clockTime(now.t_ns * 1e-6)}`);
  const estimate = byId("estimate");
  setText("estimate", quantity(scale(now.estimate_V), 5));
  Object.assign(estimate.dataset, { valueV: now.estimate_V, sigmaV: now.sigma_V, index: now.estimate_index });
  setText("sigma", now.sigma_V === null ? "" : `± ${quantity(Math.abs(stretch(now.sigma_V)), 3).slice(1)}`);
  setText("u", quantity(stretch(now.u_V), 4));
  setText("window", now.window ? String(now.window) : "–");
  setText("estimator", `${shown.status.estimator}${now.passes ? ` · ${now.passes} ${now.passes === 1 ? "pass" : "passes"}` : ""}`);
}

function showStatus() {
  const status = shown.status;
  const well = status.health === "ok";
  setText("instrument", status.instrument);
  document.title = `${status.instrument} – aemd`;
  byId("complaint").hidden = well;
  setText("complaint", well ? "" : status.health);
  setState(well ? "live" : "stalled");
  const rows = [
    ["readings", status.readings.toLocaleString("en")],
    ["rate", `${status.rate_hz.toFixed(status.rate_hz < 1000 ? 3 : 0)} /s`],
    ["lost", status.lost.toLocaleString("en"), status.lost > 0],
    ...(status.not_written ? [["not written", status.not_written.toLocaleString("en"), true]] : []),
    ["gaps", status.gaps.toLocaleString("en"), status.gaps > 0],
    ["overloads", status.overloads.toLocaleString("en"), status.overloads > 0],
    ["disk free", bytes(status.disk_free_bytes), status.disk_free_bytes < 1e9],
    ["file", status.file === null ? "–" : status.file.split("/").pop()],
    ["size", bytes(status.file_bytes)],
    ["uptime", duration(status.uptime_s)],
  ];
  const list = byId("health");
  while (list.children.length < 2 * rows.length) {
    list.append(document.createElement("dt"), document.createElement("dd"));
  }
  rows.forEach(([name, value, bad], row) => {
    const [term, text] = [list.children[2 * row], list.children[2 * row + 1]];
    term.textContent = name;
    text.textContent = value;
    text.id = `health-${name.replace(" ", "-")}`;
    text.classList.toggle("bad", Boolean(bad));
  });
  showEvents(status.events);
}

function showEvents(events) {
  const key = JSON.stringify(events);
  if (byId("events").dataset.key === key) return;
  byId("events").dataset.key = key;
  const items = events.slice().reverse().map((event) => {
    const item = document.createElement("li");
    const time = document.createElement("time");
    time.textContent = clockTime(1e3 * event.time_s);
    item.append(time, `${event.kind}: ${event.message}`);
    return item;
  });
  if (!items.length) items.push(Object.assign(document.createElement("li"), { textContent: "none" }));
  byId("events").replaceChildren(...items);
}

function setState(state) {
  const text = shown.paused ? "paused" : state;
  byId("state").dataset.state = text;
  setText("state", text);
}

// -- charts ----------------------------------------------------------------------------------------------------------

const MARGIN = { left: 54, right: 8, top: 8, bottom: 20 };
const FONT = '11px system-ui, "DejaVu Sans", sans-serif';
const TIME_STEPS_S = [0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 20, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200];

function readColours() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["card", "ink", "muted", "grid", "readings", "estimate", "band", "u", "window", "select", "bad"]) {
    colours[name] = style.getPropertyValue(`--${name}`).trim();
  }
}

// Clear a canvas of the right size; return its context and its plot area in CSS pixels.
function begin(canvas) {
  const [width, height, ratio] = [canvas.clientWidth, canvas.clientHeight, window.devicePixelRatio || 1];
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const pen = canvas.getContext("2d");
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = FONT;
  pen.lineJoin = "round";
  const area = { x0: MARGIN.left, x1: width - MARGIN.right, y0: MARGIN.top, y1: height - MARGIN.bottom };
  return [pen, area];
}

function niceStep(range, most) {
  const rough = range / Math.max(1, most);
  const power = 10 ** Math.floor(Math.log10(rough));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= rough * (1 - 1e-9));
}

function extent(cells, low, high) {
  let [least, greatest] = [Infinity, -Infinity];
  for (const cell of cells) {
    if (cell[low] !== null && cell[low] < least) least = cell[low];
    if (cell[high] !== null && cell[high] > greatest) greatest = cell[high];
  }
  return [least, greatest];
}

function padded([low, high]) {
  if (!(low <= high)) return [-1, 1];
  const room = high > low ? 0.06 * (high - low) : Math.max(1e-9, 1e-6 * Math.abs(high));
  return [low - room, high + room];
}

function line(pen, x0, y0, x1, y1, colour, width = 1) {
  pen.beginPath();
  pen.moveTo(x0, y0);
  pen.lineTo(x1, y1);
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.stroke();
}

// Draw a y axis of quantities (already in the sensor's unit); return the map from value to pixel.
function drawY(pen, area, [low, high], asQuantity) {
  const toY = (value) => area.y1 - ((value - low) / (high - low)) * (area.y1 - area.y0);
  const step = niceStep(high - low, (area.y1 - area.y0) / (area.y1 - area.y0 > 150 ? 34 : 24));
  const [size, name] = asQuantity ? prefixFor(Math.max(Math.abs(low), Math.abs(high))) : [1, ""];
  const decimals = Math.min(9, Math.max(0, -Math.floor(Math.log10(step / size) + 1e-9)));
  pen.textBaseline = "middle";
  pen.textAlign = "right";
  const first = Math.ceil(low / step - 1e-9);
  for (let k = first; k * step <= high * (1 + 1e-12) + 1e-15; k += 1) {
    const y = Math.round(toY(k * step)) + 0.5;
    line(pen, area.x0, y, area.x1, y, colours.grid);
    pen.fillStyle = colours.muted;
    pen.fillText(((k * step) / size).toFixed(decimals).replace("-", "−"), area.x0 - 6, y);
  }
  if (name) {
    pen.textAlign = "left";
    pen.fillText(name, 2, area.y1 + 12);
  }
  return toY;
}

function drawTimes(pen, area, view) {
  const most = (area.x1 - area.x0) / 66;
  const step = 1e3 * (TIME_STEPS_S.find((s) => (1e3 * s) >= (view.end - view.begin) / most) || 86400);
  const shift = 6e4 * new Date(view.end).getTimezoneOffset(); // ticks at the user's full hours
  pen.textBaseline = "top";
  for (let k = Math.ceil((view.begin - shift) / step); k * step + shift <= view.end; k += 1) {
    const x = Math.round(view.toX(k * step + shift)) + 0.5;
    line(pen, x, area.y0, x, area.y1, colours.grid);
    const text = step >= 6e4 ? clockTime(k * step + shift).slice(0, 5) : clockTime(k * step + shift, step < 1e3 ? 1 : 0);
    const half = pen.measureText(text).width / 2;
    if (x - half < area.x0 - 4 || x + half > area.x1 + MARGIN.right) continue;
    pen.textAlign = "center";
    pen.fillStyle = colours.muted;
    pen.fillText(text, x, area.y1 + 6);
  }
}

function clip(pen, area) {
  pen.save();
  pen.beginPath();
  pen.rect(area.x0, area.y0 - 2, area.x1 - area.x0, area.y1 - area.y0 + 4);
  pen.clip();
}

// Runs of neighbouring cells: a line across a hole would invent readings.
function runs(cells, apart_ms, name) {
  const found = [];
  let run = null;
  for (const cell of cells) {
    if (cell[name] === null) { run = null; continue; }
    if (!run || cell.t - run[run.length - 1].t > apart_ms) found.push((run = []));
    run.push(cell);
  }
  return found;
}

// Through the least and the greatest value of each bin: no extreme is lost.
function drawEnvelope(pen, found, toX, low, high, colour, width) {
  pen.strokeStyle = colour;
  pen.lineWidth = width;
  pen.beginPath();
  for (const run of found) {
    run.forEach((cell, at) => {
      const x = toX(cell.t);
      if (at) pen.lineTo(x, low(cell)); else pen.moveTo(x, low(cell));
      if (cell.lo !== cell.hi) pen.lineTo(x, high(cell));
    });
    if (run.length === 1) pen.lineTo(toX(run[0].t) + 1, high(run[0]));
  }
  pen.stroke();
}

function drawDots(pen, cells, toX, y, colour, radius) {
  pen.fillStyle = colour;
  pen.beginPath();
  for (const cell of cells) {
    if (cell.lo === null) continue;
    pen.moveTo(toX(cell.t) + radius, y(cell));
    pen.arc(toX(cell.t), y(cell), radius, 0, 2 * Math.PI);
  }
  pen.fill();
}

function currentView() {
  if (shown.zoom) return shown.zoom;
  const end = newest() || Date.now();
  const interval_ms = shown.status ? 1e3 * shown.status.interval_s : 0;
  return {
    begin: end - 1e3 * spanS(), end, readings: store.readings, estimates: store.estimates,
    apart_ms: 1.5 * store.bin_ms + 2.5 * interval_ms,
  };
}

function drawTimeCharts() {
  const view = currentView();
  drawInput(view);
  const toU = (cells) => padded(extent(cells, "u_lo", "u_hi").map((value) => (Number.isFinite(value) ? stretch(value) : 0)).sort((a, b) => a - b));
  drawSeries("chart-u", view, toU(view.estimates), true, "u_lo", "u_hi", stretch, colours.u);
  const highest = extent(view.estimates, "w_lo", "w_hi")[1];
  const windows = [0, Math.max(4, 1.15 * (Number.isFinite(highest) ? highest : 0))];
  drawSeries("chart-window", view, windows, false, "w_lo", "w_hi", (value) => value, colours.window);
}

function setUp(canvas, view) {
  const [pen, area] = begin(canvas);
  view.toX = (t) => area.x0 + ((t - view.begin) / (view.end - view.begin)) * (area.x1 - area.x0);
  view.toTime = (x) => view.begin + ((x - area.x0) / (area.x1 - area.x0)) * (view.end - view.begin);
  view.area = area;
  return [pen, area];
}

function drawInput(view) {
  const canvas = byId("chart-input");
  const [pen, area] = setUp(canvas, view);
  const limits = [extent(view.readings, "lo", "hi"), extent(view.estimates, "band_lo", "band_hi")].flat();
  const values = limits.filter(Number.isFinite).map(scale).sort((a, b) => a - b);
  const toY = drawY(pen, area, padded([values[0], values[values.length - 1]]), true);
  drawTimes(pen, area, view);
  clip(pen, area);
  const y = (name) => (cell) => toY(scale(cell[name]));
  const estimated = runs(view.estimates, view.apart_ms, "mean");
  const read = runs(view.readings, view.apart_ms, "lo");
  drawEnvelope(pen, read, view.toX, y("lo"), y("hi"), colours.readings, 1);
  pen.fillStyle = colours.band; // over the readings, which would hide it
  for (const run of estimated) {
    pen.beginPath();
    run.forEach((cell) => pen.lineTo(view.toX(cell.t), y("band_hi")(cell)));
    run.slice().reverse().forEach((cell) => pen.lineTo(view.toX(cell.t), y("band_lo")(cell)));
    pen.fill();
  }
  if ((area.x1 - area.x0) / view.readings.length > 3) drawDots(pen, view.readings, view.toX, y("lo"), colours.readings, 1.7);
  drawEnvelope(pen, estimated, view.toX, y("mean"), y("mean"), colours.estimate, 1.5);
  pen.fillStyle = colours.bad; // readings without a value, along the bottom
  for (const cell of view.readings) if (cell.bad > 0) pen.fillRect(view.toX(cell.t) - 1, area.y1 - 6, 2.5, 6);
  drawPointer(pen, area, view);
  pen.restore();
  Object.assign(canvas.dataset, {
    drawn: Number(canvas.dataset.drawn || 0) + 1, begin: view.begin, end: view.end, cells: view.readings.length,
    low: values[0], high: values[values.length - 1],
  });
}

function drawSeries(id, view, range, asQuantity, low, high, toValue, colour) {
  const [pen, area] = setUp(byId(id), view);
  const toY = drawY(pen, area, range, asQuantity);
  drawTimes(pen, area, view);
  clip(pen, area);
  const found = runs(view.estimates, view.apart_ms, low);
  drawEnvelope(pen, found, view.toX, (cell) => toY(toValue(cell[low])), (cell) => toY(toValue(cell[high])), colour, 1.3);
  drawPointer(pen, area, view);
  pen.restore();
}

function drawPointer(pen, area, view) {
  const pointer = shown.pointer;
  if (!pointer) return;
  if (pointer.from !== null) {
    pen.fillStyle = colours.select;
    pen.fillRect(Math.min(pointer.from, pointer.x), area.y0, Math.abs(pointer.x - pointer.from), area.y1 - area.y0);
  }
  line(pen, pointer.x, area.y0, pointer.x, area.y1, colours.muted, 0.7);
  const t = view.toTime(pointer.x);
  const nearest = (cells) => cells.reduce((best, cell) => (!best || Math.abs(cell.t - t) < Math.abs(best.t - t) ? cell : best), null);
  const [reading, estimate] = [nearest(view.readings), nearest(view.estimates)];
  if (!reading || !shown.status) return;
  const range = reading.lo === reading.hi ? quantity(scale(reading.lo)) : `${quantity(scale(reading.lo), 4)} … ${quantity(scale(reading.hi), 4)}`;
  const about = estimate ? ` · estimate ${quantity(scale(estimate.mean))} · window ${estimate.w_hi}` : "";
  setText("at", `${clockTime(reading.t, 2)} · ${range}${about}`);
}

function drawHistogram() {
  const histogram = shown.histogram && shown.histogram[byId("histogram-of").value];
  const [pen, area] = begin(byId("chart-histogram"));
  if (!histogram || !histogram.counts) return;
  const { counts, step_V: step, from_V: from } = histogram;
  const total = counts.reduce((sum, count) => sum + count, 0);
  const most = Math.max(...counts);
  const toY = drawY(pen, area, [0, 1.08 * most], false);
  const range = [from, from + step * counts.length];
  const toX = (volts) => area.x0 + ((volts - range[0]) / (range[1] - range[0])) * (area.x1 - area.x0);
  pen.fillStyle = colours.readings;
  counts.forEach((count, k) => {
    const [x0, x1] = [toX(from + k * step), toX(from + (k + 1) * step)];
    pen.fillRect(x0 + 0.5, toY(count), Math.max(1, x1 - x0 - 1), area.y1 - toY(count));
  });
  pen.beginPath(); // the normal distribution of the same middle and spread
  for (let k = 0; k <= 80; k += 1) {
    const z = -4 + k / 10;
    const height = (total * step * Math.exp(-0.5 * z * z)) / (histogram.spread_V * Math.sqrt(2 * Math.PI));
    pen.lineTo(toX(histogram.median_V + z * histogram.spread_V), toY(height));
  }
  pen.strokeStyle = colours.estimate;
  pen.lineWidth = 1.5;
  pen.stroke();
  pen.fillStyle = colours.muted;
  pen.textBaseline = "top";
  const asValue = byId("histogram-of").value === "readings" ? scale : stretch;
  [-3, 0, 3].forEach((z) => {
    pen.textAlign = "center";
    const at = histogram.median_V + z * histogram.spread_V;
    const nothing = Math.abs(asValue(at)) < 1e-3 * Math.abs(stretch(histogram.spread_V));  // of this axis
    pen.fillText(nothing ? "0" : quantity(asValue(at), 3), toX(at), area.y1 + 6);
  });
  setText("histogram-text", `σ ${quantity(Math.abs(stretch(histogram.spread_V)), 3).slice(1)} · n ${total}`);
  byId("chart-histogram").dataset.total = total;
}

function drawAllan() {
  const canvas = byId("chart-allan");
  const [pen, area] = begin(canvas);
  if (!shown.allan) return;
  const curves = ["readings", "estimates"].map((name) => {
    const { length, deviation_V, pairs } = shown.allan[name];
    return length.map((m, k) => ({ tau: m * shown.status.interval_s, dev: Math.abs(stretch(deviation_V[k])), pairs: pairs[k] })).filter((point) => point.dev > 0);
  });
  const all = curves.flat();
  if (!all.length) return;
  const decades = (values) => [Math.floor(Math.log10(Math.min(...values))), Math.ceil(Math.log10(Math.max(...values)) + 1e-9)];
  const [[x0, x1], [y0, y1]] = [decades(all.map((point) => point.tau)), decades(all.map((point) => point.dev))];
  const toX = (tau) => area.x0 + ((Math.log10(tau) - x0) / (x1 - x0)) * (area.x1 - area.x0);
  const toY = (dev) => area.y1 - ((Math.log10(dev) - y0) / (y1 - y0)) * (area.y1 - area.y0);
  pen.fillStyle = colours.muted;
  for (let k = x0; k <= x1; k += 1) {
    line(pen, toX(10 ** k), area.y0, toX(10 ** k), area.y1, colours.grid);
    pen.textAlign = k === x0 ? "left" : k === x1 ? "right" : "center";
    pen.textBaseline = "top";
    pen.fillText(k < -2 ? `1e${k} s` : `${10 ** k} s`, toX(10 ** k), area.y1 + 6);
  }
  for (let k = y0; k <= y1; k += 1) {
    line(pen, area.x0, toY(10 ** k), area.x1, toY(10 ** k), colours.grid);
    const [size, name] = prefixFor(1.0001 * 10 ** k);
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    pen.fillText(`${Number((10 ** k / size).toPrecision(3))} ${name}`, area.x0 - 6, toY(10 ** k));
  }
  clip(pen, area);
  curves.forEach((points, which) => {
    const colour = which ? colours.estimate : colours.readings;
    pen.beginPath();
    points.forEach(({ tau, dev }) => pen.lineTo(toX(tau), toY(dev)));
    pen.strokeStyle = colour;
    pen.lineWidth = 1.6;
    pen.stroke();
    points.forEach(({ tau, dev, pairs }) => {
      const spread = dev / Math.sqrt(pairs); // one standard deviation, roughly
      line(pen, toX(tau), toY(Math.max(dev - spread, 10 ** y0)), toX(tau), toY(dev + spread), colour);
      pen.fillStyle = colour;
      pen.fillRect(toX(tau) - 2, toY(dev) - 2, 4, 4);
    });
  });
  pen.restore();
  canvas.dataset.points = curves[0].length;
}

function redraw() {
  if (redrawAsked) return;
  redrawAsked = true;
  requestAnimationFrame(() => {
    redrawAsked = false;
    if (!shown.status) return;
    drawTimeCharts();
    drawHistogram();
    drawAllan();
  });
}

// -- what the user does ----------------------------------------------------------------------------------------------

function setPaused(paused) {
  shown.paused = paused;
  byId("pause").textContent = paused ? "Resume" : "Pause";
  byId("pause").setAttribute("aria-pressed", String(paused));
  if (paused) disconnect(); else connect();
  setState("connecting");
}

async function zoomTo(begin_ms, end_ms) {
  const answer = await fetch(`window?begin_ms=${begin_ms}&end_ms=${end_ms}&columns=${chartColumns()}`);
  if (!answer.ok) return;
  const found = await answer.json();
  const zoom = { begin: begin_ms, end: end_ms, readings: [], estimates: [], apart_ms: 1.5 * found.bin_ms + 2500 * shown.status.interval_s };
  append(zoom.readings, found.readings, found.bin_ms);
  append(zoom.estimates, found.estimates, found.bin_ms);
  shown.zoom = zoom;
  byId("live").hidden = false;
  redraw();
}

function leaveZoom() {
  shown.zoom = null;
  byId("live").hidden = true;
  redraw();
}

function follow(canvas) {
  const at = (event) => {
    const { area } = currentOrLast();
    return Math.min(area.x1, Math.max(area.x0, event.clientX - canvas.getBoundingClientRect().left));
  };
  canvas.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || !shown.status) return;
    canvas.setPointerCapture(event.pointerId);
    const x = at(event);
    shown.pointer = { x, from: x, view: held() };
    redraw();
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!shown.status) return;
    shown.pointer = { from: null, view: null, ...shown.pointer, x: at(event) };
    redraw();
  });
  canvas.addEventListener("pointerup", () => {
    const pointer = shown.pointer;
    if (!pointer || pointer.from === null) return;
    const ends = [pointer.from, pointer.x].sort((a, b) => a - b).map(pointer.view);
    shown.pointer = { ...pointer, from: null };
    if (Math.abs(pointer.x - pointer.from) > 8 && ends[1] - ends[0] > 2) zoomTo(ends[0], ends[1]);
    redraw();
  });
  for (const name of ["pointerleave", "pointercancel"]) {
    canvas.addEventListener(name, () => {
      shown.pointer = null;
      setText("at", "");
      redraw();
    });
  }
  canvas.addEventListener("dblclick", leaveZoom);
}

function currentOrLast() {
  const view = currentView();
  setUp(byId("chart-input"), view);
  redraw();
  return view;
}

// The times under the pixels at this moment: while the user drags, the charts move on.
function held() {
  const { begin: from, end, area } = currentOrLast();
  return (x) => from + ((x - area.x0) / (area.x1 - area.x0)) * (end - from);
}

function main() {
  readColours();
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readColours(); redraw(); });
  byId("pause").addEventListener("click", () => setPaused(!shown.paused));
  byId("live").addEventListener("click", leaveZoom);
  byId("histogram-of").addEventListener("change", redraw);
  byId("span").addEventListener("change", () => { leaveZoom(); setPaused(false); });
  document.addEventListener("keydown", (event) => { if (event.key === "Escape") leaveZoom(); });
  document.addEventListener("visibilitychange", () => {
    if (document.hidden) disconnect(); else if (!shown.paused) connect(); // nobody looks: nothing is sent
  });
  for (const id of ["chart-input", "chart-u", "chart-window"]) follow(byId(id));
  let columns = chartColumns();
  new ResizeObserver(() => {
    redraw();
    if (chartColumns() > 1.3 * columns && !shown.paused) connect();
    columns = Math.max(columns, chartColumns());
  }).observe(document.querySelector("main"));
  connect();
}

main();
