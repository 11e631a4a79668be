"use strict";
/* Residuals against their predictions, drawn as SVG: one row a channel, against the angle and against the time. */
const BenchPlots = (() => {
  const NS = "http://www.w3.org/2000/svg";
  const CHANNELS = ["x", "y", "z"];
  const W = 460, H = 170, LEFT = 62, RIGHT = 10, TOP = 10, BOTTOM = 30;
  const SHAPES = ["round", "square", "triangle", "diamond"];
  /* Bands this many times wider than the narrowest are cut off at the edge: the first readings know nothing yet. */
  const WIDEST = 6;

  /* The share of a normal distribution beyond ± k (Abramowitz and Stegun, 26.2.17; good to 1e-7). */
  const BY_CHANCE = (k) => {
    const t = 1 / (1 + 0.2316419 * k);
    const tail = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))));
    return 2 * Math.exp(-k * k / 2) / Math.sqrt(2 * Math.PI) * tail;
  };

  const el = (name, attributes, text) => {
    const made = document.createElementNS(NS, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== undefined) made.textContent = text;
    return made;
  };

  const scaleFor = (largest, unit) => {
    if (unit !== "V") return { size: 1, unit };
    for (const [prefix, size] of [["", 1], ["m", 1e-3], ["µ", 1e-6]]) if (largest >= size) return { size, unit: prefix + unit };
    return { size: 1e-9, unit: "nV" };
  };

  const number = (value, digits) => {
    const text = Math.abs(value).toPrecision(digits);
    return (value < 0 ? "−" : "+") + Number(text);
  };

  const span = (points, channel, k) => {
    const own = points.filter((p) => !p.struck);
    const narrowest = Math.min(...own.map((p) => p.u[channel]));
    const known = own.filter((p) => p.u[channel] <= WIDEST * narrowest);
    const sizes = known.map((p) => Math.max(k * p.u[channel], Math.abs(p.residual[channel])));
    return 1.15 * Math.max(...sizes, 3 * narrowest);
  };

  const ticks = (low, high) => {
    const raw = (high - low) / 4;
    const power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((n) => n * power).find((n) => n >= raw);
    const found = [];
    for (let at = Math.ceil(low / step) * step; at <= high + step * 1e-6; at += step) found.push(Math.round(at / step) * step);
    return found;
  };

  const mark = (shape, x, y, kind) => {
    const r = 4.2;
    switch (shape) {
      case "square": return el("rect", { class: kind, x: x - r, y: y - r, width: 2 * r, height: 2 * r });
      case "triangle": return el("path", { class: kind, d: `M${x} ${y - r * 1.25}L${x + r * 1.2} ${y + r}L${x - r * 1.2} ${y + r}Z` });
      case "diamond": return el("path", { class: kind, d: `M${x} ${y - r * 1.4}L${x + r * 1.4} ${y}L${x} ${y + r * 1.4}L${x - r * 1.4} ${y}Z` });
      default: return el("circle", { class: kind, cx: x, cy: y, r });
    }
  };

  const cross = (x, y) => el("path", { class: "struck", d: `M${x - 4} ${y - 4}L${x + 4} ${y + 4}M${x - 4} ${y + 4}L${x + 4} ${y - 4}` });

  const along = {
    angle: () => ({ low: -12, high: 372, of: (p) => ((p.angle_deg % 360) + 360) % 360 || (p.angle_deg > 180 ? 360 : 0), ticks: [0, 90, 180, 270, 360], name: "angle / °", size: 1 }),
    time: (points) => {
      const last = points[points.length - 1].time_s, first = points[0].time_s;
      const [name, size] = last - first > 7200 ? ["time / h", 3600] : ["time / min", 60];
      const room = Math.max((last - first) / size * 0.03, 0.02);
      const low = first / size - room, high = last / size + room;
      return { low, high, of: (p) => p.time_s / size, ticks: ticks(low, high), name, size };
    },
  };

  const draw = (svg, points, channel, k, way, shapes) => {
    const axis = along[way](points);
    const most = span(points, channel, k);
    const unit = scaleFor(most, points[points.length - 1].unit);
    const px = (v) => LEFT + (v - axis.low) / (axis.high - axis.low) * (W - LEFT - RIGHT);
    const py = (v) => TOP + (1 - Math.max(-1, Math.min(1, v / most))) / 2 * (H - TOP - BOTTOM);
    const made = [];
    for (const at of ticks(-most / unit.size, most / unit.size)) {
      made.push(el("line", { class: at === 0 ? "zero" : "rule", x1: LEFT, x2: W - RIGHT, y1: py(at * unit.size), y2: py(at * unit.size) }));
      made.push(el("text", { class: "tick", x: LEFT - 6, y: py(at * unit.size), "text-anchor": "end", "dominant-baseline": "central" }, (at < 0 ? "−" : "") + Math.abs(Number(at.toPrecision(6)))));
    }
    for (const at of axis.ticks) {
      made.push(el("line", { class: "rule", x1: px(at), x2: px(at), y1: TOP, y2: H - BOTTOM }));
      made.push(el("text", { class: "tick", x: px(at), y: H - BOTTOM + 13, "text-anchor": "middle" }, String(Number(at.toPrecision(6)))));
    }
    made.push(el("text", { class: "tick", x: (LEFT + W - RIGHT) / 2, y: H - 3, "text-anchor": "middle" }, axis.name));
    made.push(el("text", { class: "tick", x: 12, y: (TOP + H - BOTTOM) / 2, "text-anchor": "middle", transform: `rotate(-90 12 ${(TOP + H - BOTTOM) / 2})` }, `${CHANNELS[channel]} / ${unit.unit}`));
    if (way === "time") {
      const standing = points.filter((p) => !p.struck);
      const upper = standing.map((p) => `${px(axis.of(p)).toFixed(1)} ${py(k * p.u[channel]).toFixed(1)}`);
      const lower = standing.map((p) => `${px(axis.of(p)).toFixed(1)} ${py(-k * p.u[channel]).toFixed(1)}`).reverse();
      if (upper.length > 1) made.push(el("path", { class: "band", d: `M${upper.join("L")}L${lower.join("L")}Z` }));
    } else {
      for (const p of points) if (!p.struck) made.push(el("rect", { class: "band", x: px(axis.of(p)) - 5, width: 10, y: py(k * p.u[channel]), height: Math.max(1, py(-k * p.u[channel]) - py(k * p.u[channel])) }));
    }
    points.forEach((p, i) => {
      const x = px(axis.of(p)), y = py(p.residual[channel]);
      if (p.struck) { made.push(cross(x, y)); return; }
      const outside = Math.abs(p.residual[channel]) > k * p.u[channel];
      if (i === points.length - 1) made.push(el("circle", { class: "newest", cx: x, cy: y, r: 9 }));
      made.push(mark(shapes.get(p.installation), x, y, `mark ${CHANNELS[channel]}${outside ? " outside" : ""}`));
      if (outside) made.push(el("text", { class: "flag", x, y: y - 12 < TOP ? y + 14 : y - 9, "text-anchor": "middle" }, "!"));
    });
    svg.replaceChildren(...made);
  };

  const words = (points, channel, k) => {
    const last = points[points.length - 1];
    const unit = scaleFor(k * last.u[channel], last.unit);
    const standing = points.filter((p) => !p.struck);
    const outside = standing.filter((p) => Math.abs(p.residual[channel]) > k * p.u[channel]).length;
    return `${CHANNELS[channel]}: last ${number(last.residual[channel] / unit.size, 3)} ${unit.unit}, band ±${Number((k * last.u[channel] / unit.size).toPrecision(2))} ${unit.unit} (k = ${k}); ${outside} of ${standing.length} outside`;
  };

  /* Draws all into a place that has an svg and a p for each channel; the svgs are kept, only what is in them changes. */
  const show = (place, points, k) => {
    place.hidden = points.length === 0;
    if (!points.length) return;
    const labels = [...new Set(points.map((p) => p.installation))];
    const shapes = new Map(labels.map((label, i) => [label, SHAPES[i % SHAPES.length]]));
    CHANNELS.forEach((name, channel) => {
      for (const way of ["angle", "time"]) {
        const svg = place.querySelector(`svg[data-channel="${name}"][data-along="${way}"]`);
        svg.setAttribute("aria-label", `Residuals of channel ${words(points, channel, k)}, against the ${way}`);
        draw(svg, points, channel, k, way, shapes);
      }
      place.querySelector(`p[data-channel="${name}"]`).textContent = words(points, channel, k);
    });
    place.querySelector("[data-legend]").textContent = labels.map((label) => `${shapes.get(label)}: installation ${label}`).join("; ");
    place.dataset.newest = points[points.length - 1].n;
  };

  /* How many values of all channels lie outside their bands, and how many do by chance (normal, two-sided). */
  const outside = (points, k) => {
    const standing = points.filter((p) => !p.struck);
    const values = standing.length * CHANNELS.length;
    const found = standing.reduce((sum, p) => sum + CHANNELS.filter((_, i) => Math.abs(p.residual[i]) > k * p.u[i]).length, 0);
    return { values, outside: found, expected: Math.round(values * BY_CHANCE(k)) };
  };
  return { show, outside };
})();
