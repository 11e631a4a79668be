"use strict";
/* What a plot is made of: numbers in words, axes, marks, bands. It is drawn as SVG; plots-chart.js has what one does with it. */
const BenchDrawing = (() => {
  const NS = "http://www.w3.org/2000/svg";
  const RIGHT = 14, TOP = 12, BOTTOM = 34;
  const SHAPES = ["round", "square", "triangle", "diamond"];
  /* Bands this many times wider than the narrowest are cut off at the edge: the first readings know nothing yet. */
  const WIDEST = 6;
  /* Passes at the same angle stand side by side, within this many degrees. */
  const DODGE_DEG = 5, BESIDE_DEG = 7;

  const el = (name, attributes, text) => {
    const made = document.createElementNS(NS, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== undefined) made.textContent = _(text);
    return made;
  };

  const made = (name, text, kind) => {
    const one = document.createElement(name);
    if (text !== undefined) one.textContent = _(text);
    if (kind) one.className = kind;
    return one;
  };

  /* --- numbers in words ------------------------------------------------------------------------------------------- */

  const scaleFor = (largest, unit) => {
    if (!["V", "g"].includes(unit)) return { size: 1, unit };
    for (const [prefix, size] of [["", 1], ["m", 1e-3], ["µ", 1e-6]]) if (largest >= size) return { size, unit: prefix + unit };
    return { size: 1e-9, unit: `n${unit}` };
  };
  const unsigned = (text) => text.replace(/^-(?=[0.]*$)/, "");  /* no zero has a sign */
  const signed = (text) => (Number(text) === 0 ? unsigned(text) : text.startsWith("-") ? `−${text.slice(1)}` : `+${text}`);
  const plain = (value) => (value < 0 ? "−" : "") + Math.abs(Number(value.toPrecision(6)));

  /* A value with two digits of its uncertainty: "−12.3 ± 4.5 µV". */
  const withU = (value, u, unit) => {
    const scale = scaleFor(Math.max(Math.abs(value), u || 0), unit);
    if (!u) return `${plain(Number((value / scale.size).toPrecision(4)))} ${scale.unit}`.trim();
    const places = Math.min(9, Math.max(0, 1 - Math.floor(Math.log10(u / scale.size))));
    return `${signed((value / scale.size).toFixed(places))} ± ${(u / scale.size).toFixed(places)} ${scale.unit}`.trim();
  };

  /* An angle with a true minus, and none before nought. */
  const degrees = (angle, places) => `${unsigned(angle.toFixed(places)).replace("-", "−")}°`;
  const timeUnit = (seconds) => (seconds > 7200 ? ["h", 3600] : ["min", 60]);
  const place = (point) => {
    const told = point.angle === null ? [] : [degrees(point.angle, 4)];
    if (point.time !== null) {
      const [unit, size] = timeUnit(point.time);
      told.push(`${(point.time / size).toFixed(2)} ${unit}`);
    }
    return told.join(" · ");
  };

  /* What stands at a point, in lines: its value with its uncertainty, its angle and time, its place in the procedure. */
  const lines = (spec, point, channel) => {
    const name = spec.channels[channel];
    const [u, which] = point.U ? [point.U[channel], ` (U, k = ${plain(spec.k)})`] : [point.u ? point.u[channel] : 0, point.u ? " (u)" : ""];
    const value = `${name ? `${name}: ` : ""}${withU(point.value[channel], u, spec.unit)}${which}`;
    return [value, place(point), `${point.where}${point.struck ? ", redone" : ""}`].filter(Boolean);
  };

  /* --- axes -------------------------------------------------------------------------------------------------------- */

  const ticks = (low, high, most = 6) => {
    const raw = (high - low) / most;
    const power = 10 ** Math.floor(Math.log10(raw));
    const step = [1, 2, 5, 10].map((n) => n * power).find((n) => n >= raw * 0.999);
    const found = [];
    for (let at = Math.ceil(low / step - 1e-6) * step; at <= high + step * 1e-6; at += step) found.push(Math.round(at / step) * step);
    return found;
  };

  const round = (angle) => ((angle % 360) + 360) % 360 || (angle > 180 ? 360 : 0);
  const angleAxis = (points) => {
    const passes = points.map((p) => p.pass || 0), first = Math.min(...passes), last = Math.max(...passes);
    const beside = (p) => (last > first ? DODGE_DEG * ((p.pass || 0) - (first + last) / 2) / (last - first) : 0);
    return { low: -12, high: 372, of: (p) => round(p.angle) + beside(p) + (p.beside || 0) * BESIDE_DEG, ticks: [0, 90, 180, 270, 360], name: _("head angle / °") };
  };
  const timeAxis = (points) => {
    if (points.some((p) => p.time === null)) {
      const most = Math.max(...points.map((p) => p.order));
      return { low: 0.4, high: most + 0.6, of: (p) => p.order + (p.beside || 0) * 0.15, name: _("reading, in order") };
    }
    const times = points.map((p) => p.time), first = Math.min(...times), last = Math.max(...times);
    const [unit, size] = timeUnit(last - first);
    const room = Math.max((last - first) / size * 0.03, 0.02);
    return { low: first / size - room, high: last / size + room, of: (p) => p.time / size, name: _(`time / ${unit}`) };
  };
  const valueAxis = (points, spec) => {
    const values = points.map((p) => p.value[0]), low = Math.min(0, ...values), high = Math.max(0, ...values);
    const room = 0.06 * (high - low || 1);
    return { low: low < 0 ? low - room : 0, high: high + room, of: (p) => p.value[0], name: spec.axis };
  };
  const AXES = { angle: angleAxis, time: timeAxis, value: valueAxis };

  /* The range of values that shows all; the widest bands and the limits count as far as their kind says. */
  const fullRange = (spec, channel, points) => {
    if (spec.kind === "bars") return [points.length - 0.4, -0.6];
    const values = points.map((p) => p.value[channel]);
    if (spec.kind === "signal") {
      const low = Math.min(...values), high = Math.max(...values), room = 0.08 * (high - low || 1);
      return [low - room, high + room];
    }
    if (spec.kind === "whiskers") {
      const most = 1.15 * Math.max(spec.limit || 0, ...points.map((p) => Math.abs(p.value[0]) + p.U[0]));
      return [-most, most];
    }
    const own = points.filter((p) => !p.struck);
    const narrowest = Math.min(...own.map((p) => (p.u ? p.u[channel] : Infinity)));
    const known = own.filter((p) => !p.u || p.u[channel] <= WIDEST * narrowest);
    const most = 1.15 * Math.max(...known.map((p) => Math.max(p.u ? spec.k * p.u[channel] : 0, Math.abs(p.value[channel]))), 3 * narrowest);
    return [-most, most];
  };

  /* --- marks ------------------------------------------------------------------------------------------------------- */

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
  const whisker = (x, low, high, kind) => el("path", { class: kind, d: `M${x} ${low}V${high}M${x - 4} ${low}h8M${x - 4} ${high}h8` });

  const isOutside = (spec, point, channel) => {
    if (spec.kind === "whiskers") return point.passed === false;
    return Boolean(point.u) && spec.kind === "band" && Math.abs(point.value[channel]) > spec.k * point.u[channel];
  };

  /* --- a plot ------------------------------------------------------------------------------------------------------ */

  /* The frame of a pane: where values stand in its picture, and back. A pane that is not zoomed holds what lies beyond its edge. */
  const frameOf = (pane) => {
    const { spec, way, channel, width, zoom } = pane;
    const all = [...pane.points, ...pane.grey];
    const axis = AXES[way](all, spec), whole = fullRange(spec, channel, all);
    const across = zoom[way] || [axis.low, axis.high], up = zoom.y[channel] || whole;
    const left = spec.kind === "bars" ? Math.min(width * 0.42, 290) : 62;
    const height = spec.kind === "bars" ? TOP + BOTTOM + 24 * pane.points.length : Math.round(Math.min(340, Math.max(170, width * 0.36)));
    const right = width - RIGHT, bottom = height - BOTTOM;
    const y = (value) => TOP + (up[1] - value) / (up[1] - up[0]) * (bottom - TOP);
    const held = (value) => (zoom.y[channel] ? value : Math.max(Math.min(value, Math.max(...up)), Math.min(...up)));
    return {
      left, right, top: TOP, bottom, width, height, axis, across, up, whole, full: [axis.low, axis.high],
      x: (value) => left + (value - across[0]) / (across[1] - across[0]) * (right - left),
      y: (value) => y(held(value)),
      xBack: (at) => across[0] + (at - left) / (right - left) * (across[1] - across[0]),
      yBack: (at) => up[1] - (at - TOP) / (bottom - TOP) * (up[1] - up[0]),
    };
  };

  const drawAcross = (pane, frame) => {
    const zoomed = Boolean(pane.zoom[pane.way]), made = [], most = Math.max(2, Math.min(6, Math.floor((frame.right - frame.left) / 70)));
    const found = frame.axis.ticks && !zoomed ? frame.axis.ticks : ticks(frame.across[0], frame.across[1], most);
    for (const at of found) {
      made.push(el("line", { class: "rule", x1: frame.x(at), x2: frame.x(at), y1: frame.top, y2: frame.bottom }));
      made.push(el("text", { class: "tick", x: frame.x(at), y: frame.bottom + 14, "text-anchor": "middle" }, plain(at)));
    }
    made.push(el("text", { class: "tick", x: (frame.left + frame.right) / 2, y: frame.height - 4, "text-anchor": "middle" }, frame.axis.name));
    return made;
  };

  const drawUp = (pane, frame) => {
    const { spec, channel } = pane, made = [], middle = (frame.top + frame.bottom) / 2;
    if (spec.kind === "bars") {
      const room = Math.floor(frame.left / 6.2);
      pane.points.forEach((p, i) => made.push(el("text", { class: "tick", x: frame.left - 8, y: frame.y(i), "text-anchor": "end", "dominant-baseline": "central" }, p.where.length > room ? `${p.where.slice(0, room - 1)}…` : p.where)));
      return made;
    }
    const unit = scaleFor(Math.max(...frame.up.map(Math.abs)), spec.unit);
    for (const at of ticks(frame.up[0] / unit.size, frame.up[1] / unit.size)) {
      const y = frame.y(at * unit.size);
      made.push(el("line", { class: at === 0 ? "zero" : "rule", x1: frame.left, x2: frame.right, y1: y, y2: y }));
      made.push(el("text", { class: "tick", x: frame.left - 6, y, "text-anchor": "end", "dominant-baseline": "central" }, plain(at)));
    }
    made.push(el("text", { class: "tick", x: 12, y: middle, "text-anchor": "middle", transform: `rotate(-90 12 ${middle})` }, `${spec.channels[channel]} / ${unit.unit}`));
    return made;
  };

  const drawBand = (pane, frame) => {
    const { spec, channel, way } = pane, standing = pane.points.filter((p) => !p.struck && p.u);
    const x = (p) => frame.x(frame.axis.of(p)), half = (p) => spec.k * p.u[channel];
    if (spec.kind === "whiskers" && spec.limit) {
      const lines = [spec.limit, -spec.limit].map((at) => el("line", { class: "limit", x1: frame.left, x2: frame.right, y1: frame.y(at), y2: frame.y(at) }));
      const name = el("text", { class: "tick limit-name", x: frame.right - 4, y: frame.y(spec.limit) - 4, "text-anchor": "end" }, _(`limit ±${withU(spec.limit, 0, spec.unit)}`));
      return [...lines, name];
    }
    if (spec.reference) return [el("line", { class: "limit", x1: frame.x(spec.reference), x2: frame.x(spec.reference), y1: frame.top, y2: frame.bottom })];
    if (spec.kind !== "band") return [];
    if (way === "angle") return standing.map((p) => el("rect", { class: "band", x: x(p) - 5, width: 10, y: frame.y(half(p)), height: Math.max(1, frame.y(-half(p)) - frame.y(half(p))) }));
    const ordered = [...standing].sort((a, b) => frame.axis.of(a) - frame.axis.of(b));
    const edge = (p, sign) => `${x(p).toFixed(1)} ${frame.y(sign * half(p)).toFixed(1)}`;
    if (ordered.length < 2) return [];
    return [el("path", { class: "band", d: `M${ordered.map((p) => edge(p, 1)).join("L")}L${ordered.map((p) => edge(p, -1)).reverse().join("L")}Z` })];
  };

  const drawPoint = (pane, frame, point, x, y, isNewest) => {
    const { spec, channel } = pane, letter = "xyz".includes(spec.channels[channel]) ? spec.channels[channel] : "one";
    if (point.struck) return [cross(x, y)];
    const outside = isOutside(spec, point, channel), made = [];
    if (spec.kind === "whiskers") made.push(whisker(x, frame.y(point.value[0] - point.U[0]), frame.y(point.value[0] + point.U[0]), `whisker${outside ? " outside" : ""}`));
    if (isNewest) made.push(el("circle", { class: "newest", cx: x, cy: y, r: 9 }));
    made.push(mark(pane.shapes.get(point.group) || "round", x, y, `mark ${letter}${outside ? " outside" : ""}`));
    if (outside) made.push(el("text", { class: "flag", x: x + (spec.kind === "whiskers" ? 9 : 0), y: y - 12 < frame.top ? y + 16 : y - 9, "text-anchor": "middle" }, "!"));
    return made;
  };

  const drawGrey = (pane, frame, point, x, y) => {
    const made = [el("circle", { class: "grey", cx: x, cy: y, r: 2.8 })];
    if (pane.spec.kind === "whiskers") made.unshift(whisker(x, frame.y(point.value[0] - point.U[0]), frame.y(point.value[0] + point.U[0]), "grey-whisker"));
    return made;
  };

  const drawBar = (pane, frame, point, i) => {
    const from = frame.x(0), to = frame.x(point.value[0]), made = [];
    made.push(el("rect", { class: `bar ${point.group}`, x: Math.min(from, to), y: frame.y(i) - 8, width: Math.max(1, Math.abs(to - from)), height: 16 }));
    if (point.group === "tied") made.push(el("text", { class: "tick", x: Math.max(from, to) + 4, y: frame.y(i), "dominant-baseline": "central" }, "tie"));
    return made;
  };

  /* Draws a pane into its svg; returns its frame and where each point stands. */
  const draw = (pane) => {
    const { svg, spec, channel } = pane, frame = frameOf(pane), spots = [], marks = [];
    svg.setAttribute("viewBox", `0 0 ${frame.width} ${frame.height}`);
    const spot = (p, i, grey) => {
      const x = frame.x(frame.axis.of(p)), y = spec.kind === "bars" ? frame.y(i) : frame.y(p.value[channel]);
      spots.push({ point: p, x, y, grey, index: i });
      return [x, y];
    };
    pane.grey.forEach((p, i) => marks.push(...drawGrey(pane, frame, p, ...spot(p, i, true))));
    pane.points.forEach((p, i) => {
      const [x, y] = spot(p, i, false);
      marks.push(...(spec.kind === "bars" ? drawBar(pane, frame, p, i) : drawPoint(pane, frame, p, x, y, spec.newest && i === pane.points.length - 1)));
    });
    const clip = el("clipPath", { id: `${pane.id}-clip` });
    clip.append(el("rect", { x: frame.left, y: frame.top - 8, width: frame.right - frame.left + 6, height: frame.bottom - frame.top + 16 }));
    const inner = el("g", { "clip-path": `url(#${pane.id}-clip)` });
    inner.append(...drawBand(pane, frame), ...marks);
    svg.replaceChildren(clip, ...drawAcross(pane, frame), ...drawUp(pane, frame), inner, el("g", { class: "over" }));
    return { frame, spots };
  };

  /* The label beside a point; it stays within the picture. */
  const drawLabel = (pane, spot) => {
    const over = pane.svg.querySelector(".over"), texts = lines(pane.spec, spot.point, pane.channel);
    if (spot.grey) texts[texts.length - 1] = `${spot.point.of}: ${texts[texts.length - 1]}`;
    const box = el("rect", { class: "label-box", rx: 4 }), words = texts.map((text, i) => el("text", { class: `label-line${i ? "" : " first"}` }, text));
    over.replaceChildren(el("circle", { class: "picked", cx: spot.x, cy: spot.y, r: 8 }), box, ...words);
    const wide = Math.max(...words.map((one) => one.getComputedTextLength())) + 16, high = 17 * texts.length + 8;
    const { width, height } = pane.frame;
    const x = Math.max(2, Math.min(width - wide - 2, spot.x + 12 + wide > width ? spot.x - 12 - wide : spot.x + 12));
    const y = Math.max(2, Math.min(height - high - 2, spot.y - high - 6 < 0 ? spot.y + 10 : spot.y - high - 6));
    for (const [key, value] of Object.entries({ x, y, width: wide, height: high })) box.setAttribute(key, value);
    words.forEach((one, i) => { one.setAttribute("x", x + 8); one.setAttribute("y", y + 18 + 17 * i); });
    return texts;
  };

  return { SHAPES, el, made, withU, plain, degrees, draw, drawLabel, isOutside };
})();
