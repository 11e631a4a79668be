"use strict";
/* Plots that one can ask: a label at each point, zoom, choice of channel and axis, a grey overlay, tables and pictures.

   A chart shows a spec: { title, kind, channels, unit, k, limit, ways, sets, grey, newest, table, axis }.
   kind: "band" (values in ± k·u about zero), "whiskers" (values ± U and limits), "signal", or "bars" (one value a row).
   sets: [{ name, points }], of which one is shown; grey: null, { name, points } or { name, load }, which fetches the points.
   A point: { value: [], u: [] or null, U: [] or null, angle, time, order, where, group, pass, struck, passed }. */
const BenchPlots = (() => {
  const { SHAPES, el, made, withU, plain, degrees, draw, drawLabel, isOutside } = BenchDrawing;
  const NEAR = { mouse: 24, touch: 44, pen: 30 }, DRAGGED = 8, TALL = 24, STEP = 1.6;
  const NO_ZOOM = () => ({ angle: null, time: null, value: null, y: [null, null, null] });
  let charts = 0;

  /* The share of a normal distribution beyond ± k (Abramowitz and Stegun, 26.2.17; good to 1e-7). */
  const BY_CHANCE = (k) => {
    const t = 1 / (1 + 0.2316419 * k);
    const tail = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))));
    return 2 * Math.exp(-k * k / 2) / Math.sqrt(2 * Math.PI) * tail;
  };

  const button = (text, act, pressed) => {
    const one = made("button", text, "quiet");
    one.type = "button";
    if (pressed !== undefined) one.setAttribute("aria-pressed", String(pressed));
    one.addEventListener("click", act);
    return one;
  };
  const NAMES = { round: _("round"), square: _("square"), triangle: _("triangle"), diamond: _("diamond") };
  const WAYS = { angle: _("angle"), time: _("time"), value: _("value") };
  const group = (label, ...members) => {
    const one = made("div", undefined, "plot-group");
    one.setAttribute("role", "group");
    one.setAttribute("aria-label", label);
    one.append(made("span", label, "soft"), ...members);
    return one;
  };

  /* What a pane shows, in a sentence with its numbers. */
  const words = (spec, points, channel) => {
    const name = spec.channels[channel], told = (p) => withU(p.value[channel], (p.U || p.u || [])[channel], spec.unit);
    if (spec.kind === "bars") return points.map((p) => `${p.where} ${plain(p.value[0])}${p.group === "tied" ? " (tie)" : ""}`).join("; ");
    const standing = points.filter((p) => !p.struck);
    if (!standing.length) return _(`${name}: no reading`);
    const most = standing.reduce((one, other) => (Math.abs(other.value[channel]) > Math.abs(one.value[channel]) ? other : one));
    if (spec.kind === "signal") return _(`${name}: ${standing.length} readings, the largest ${told(most)}`);
    const outside = standing.filter((p) => isOutside(spec, p, channel)).length;
    if (spec.kind === "whiskers") return _(`worst ${name}: ${told(most)} (U, k = ${plain(spec.k)}) at ${degrees(most.angle, 2)}, limit ±${withU(spec.limit, 0, spec.unit)}; ${standing.length} points${outside ? `, ${outside} not accepted` : ""}`);
    if (!spec.newest) return _(`${name}: largest ${told(most)} (u) at ${degrees(most.angle, 2)}; ${outside} of ${standing.length} outside ± ${plain(spec.k)}·u`);
    const last = points[points.length - 1];
    return _(`${name}: last ${told(last)} (u); ${outside} of ${standing.length} outside ± ${plain(spec.k)}·u`);
  };

  class Chart {
    constructor(place, spec) {
      this.place = place;
      this.id = `chart-${charts += 1}`;
      this.zoom = NO_ZOOM();
      this.chosen = { channel: -1, way: "both", set: 0, grey: false };
      this.panes = [];
      this.tools = made("div", undefined, "plot-tools");
      this.legend = made("p", undefined, "soft plot-legend");
      this.body = made("div", undefined, "pairs");
      this.said = made("p", "", "plot-said");
      this.said.setAttribute("aria-live", "polite");
      place.replaceChildren(this.tools, this.legend, this.body, this.said);
      this.show(spec);
      new ResizeObserver(() => this.draw()).observe(this.body);
    }

    get run() { return this.place.closest("[data-run]").dataset.run; }

    /* Shows a spec; what one has chosen and zoomed stays. */
    show(spec) {
      const frame = JSON.stringify([spec.channels, spec.ways, spec.sets.map((set) => set.name), spec.grey && spec.grey.name]);
      this.spec = spec;
      if (frame !== this.frame) {
        this.frame = frame;
        this.makePanes();
        this.makeTools();
      }
      this.draw();
    }

    makePanes() {
      const { channels, ways } = this.spec;
      this.panes = [];
      this.body.replaceChildren(...channels.map((name, channel) => {
        const figure = made("figure"), pair = made("div", undefined, "pair");
        const told = made("p", "", this.spec.kind === "bars" ? "visually-hidden" : "soft plot-words");
        told.dataset.channel = name;
        for (const way of ways) {
          const svg = el("svg", { class: "plot", role: "img", tabindex: "0", "data-channel": name, "data-along": way });
          const pane = { id: `${this.id}-${channel}-${way}`, svg, figure, told, channel, way, zoom: this.zoom, picked: -1, spots: [] };
          this.panes.push(pane);
          this.listen(pane);
          pair.append(svg);
        }
        figure.append(told, pair);
        return figure;
      }));
    }

    /* --- buttons ----------------------------------------------------------------------------------------------------- */

    choice(label, key, options) {
      const buttons = options.map(([text, value]) => button(text, () => { this.chosen[key] = value; this.makeTools(); this.draw(); this.focusTool(text); }, this.chosen[key] === value));
      return group(label, ...buttons);
    }

    makeTools() {
      const { channels, ways, sets, grey, title, table } = this.spec, made = [];
      if (sets.length > 1) made.push(this.choice(_("Model"), "set", sets.map((set, i) => [set.name, i])));
      if (channels.length > 1) made.push(this.choice(_("Channel"), "channel", [...channels.map((name, i) => [name, i]), [_("all"), -1]]));
      if (ways.length > 1) made.push(this.choice(_("Axis"), "way", [...ways.map((way) => [WAYS[way], way]), [_("both"), "both"]]));
      if (grey) made.push(group(_("Overlay"), button(grey.name, () => this.overlay(), this.chosen.grey)));
      const zooms = [["+", _("Zoom in"), 1 / STEP], ["−", _("Zoom out"), STEP]].map(([text, label, by]) => {
        const one = button(text, () => this.zoomBy(by));
        one.setAttribute("aria-label", label);
        return one;
      });
      made.push(group(_("Zoom"), ...zooms, button(_("Reset"), () => this.reset())));
      const saved = ["SVG", "PNG"].map((form) => button(form, () => BenchPicture.save(this, form.toLowerCase())));
      const tables = [["CSV", "csv"], ["Excel", "xlsx"]].map(([text, form]) => {
        const link = document.createElement("a");
        Object.assign(link, { className: "button quiet", textContent: text, href: `${table}.${form}`, download: `${this.run}-${table.split("/").pop()}.${form}` });
        return link;
      });
      made.push(group(_("Save"), ...tables, ...saved));
      this.tools.setAttribute("role", "group");
      this.tools.setAttribute("aria-label", _(`${title}: choice, zoom, export`));
      this.tools.replaceChildren(...made);
    }

    focusTool(text) {
      const again = [...this.tools.querySelectorAll("button")].find((one) => one.textContent === _(text));
      if (again) again.focus();
    }

    async overlay() {
      const { grey } = this.spec;
      if (!grey.points && grey.load) {
        const found = await grey.load();
        grey.points = found.points;
        grey.told = found.told;
      }
      this.chosen.grey = !this.chosen.grey && grey.points.length > 0;
      this.said.textContent = grey.points.length ? "" : grey.told;
      this.makeTools();
      this.draw();
      this.focusTool(grey.name);
    }

    /* --- zoom -------------------------------------------------------------------------------------------------------- */

    reset() {
      Object.assign(this.zoom, NO_ZOOM());
      this.draw();
    }

    /* Zooms all plots about their middles; beyond the whole the zoom ends. */
    zoomBy(factor) {
      for (const pane of this.visible().filter((one, i, all) => all.findIndex((other) => other.way === one.way) === i)) {
        this.zoom[pane.way] = scaled(pane.frame.across, pane.frame.full, factor);
      }
      for (const pane of this.spec.kind === "bars" ? [] : this.visible().filter((one, i, all) => all.findIndex((other) => other.channel === one.channel) === i)) {
        this.zoom.y[pane.channel] = scaled(pane.frame.up, pane.frame.whole, factor);
      }
      this.draw();
    }

    /* Zooms to what was dragged over: across always, up only where the box is tall. */
    zoomTo(pane, from, to) {
      const { frame } = pane;
      const inside = (at, low, high) => Math.max(low, Math.min(high, at));
      const across = [from.x, to.x].map((x) => frame.xBack(inside(x, frame.left, frame.right))).sort((a, b) => a - b);
      if (across[1] > across[0]) this.zoom[pane.way] = across;
      if (Math.abs(from.y - to.y) > TALL && this.spec.kind !== "bars") {
        this.zoom.y[pane.channel] = [from.y, to.y].map((y) => frame.yBack(inside(y, frame.top, frame.bottom))).sort((a, b) => a - b);
      }
      this.draw();
    }

    /* --- drawing ----------------------------------------------------------------------------------------------------- */

    visible() { return this.panes.filter((pane) => !pane.svg.hasAttribute("hidden")); }

    draw() {
      const { spec, chosen } = this, set = spec.sets[Math.min(chosen.set, spec.sets.length - 1)];
      const grey = chosen.grey && spec.grey && spec.grey.points ? spec.grey.points : [];
      const groups = [...new Set(set.points.map((p) => p.group))];
      const shapes = new Map(groups.map((name, i) => [name, SHAPES[i % SHAPES.length]]));
      for (const pane of this.panes) {
        const seen = (chosen.channel < 0 || chosen.channel === pane.channel) && (chosen.way === "both" || chosen.way === pane.way);
        pane.svg.toggleAttribute("hidden", !seen);
        pane.figure.hidden = chosen.channel >= 0 && chosen.channel !== pane.channel;
      }
      for (const pane of this.visible()) {
        const told = words(spec, set.points, pane.channel);
        if (pane.told.textContent !== told) pane.told.textContent = _(told);
        const against = pane.way === "value" ? "" : _(`, against the ${pane.way === "time" && set.points.some((p) => p.time === null) ? _("order of the readings") : WAYS[pane.way]}`);
        pane.svg.setAttribute("aria-label", _(`${spec.title}${spec.sets.length > 1 ? ` (${set.name})` : ""}. ${told}${against}. Arrow keys go from point to point.`));
        const width = pane.svg.clientWidth;
        if (!width) continue;
        Object.assign(pane, { spec, points: set.points, grey, shapes, width });
        Object.assign(pane, draw(pane));
        if (document.activeElement === pane.svg && pane.picked >= 0) this.pick(pane, pane.picked);
      }
      this.legend.textContent = this.legendWords(groups, shapes, grey);
    }

    legendWords(groups, shapes, grey) {
      if (this.spec.kind === "bars") return this.spec.legend || "";
      const told = this.spec.kind === "whiskers" || groups.length < 2 ? [] : groups.map((name) => _(`${NAMES[shapes.get(name)]}: installation ${name}`));
      if (grey.length) told.push(_(`grey dots: ${grey[0].of}`));
      return [this.spec.legend, told.join("; ")].filter(Boolean).join(" ");
    }

    /* --- asking ------------------------------------------------------------------------------------------------------ */

    /* Shows the label of a point; who cannot see it hears it. */
    pick(pane, index, spoken = false) {
      const spot = pane.spots.find((one) => !one.grey && one.index === index);
      if (!spot) return;
      pane.picked = index;
      const texts = drawLabel(pane, spot);
      if (spoken) this.said.textContent = texts.join("; ");
    }

    unlabel(pane) {
      const over = pane.svg.querySelector(".over");
      if (over) over.replaceChildren();
    }

    nearest(pane, at, kind) {
      const { frame } = pane, reach = NEAR[kind] || NEAR.mouse;
      if (this.spec.kind === "bars") return pane.spots.find((spot) => Math.abs(spot.y - at.y) < 12);
      const off = (spot) => Math.hypot(spot.x - at.x, spot.y - at.y);
      const seen = pane.spots.filter((spot) => spot.x >= frame.left - 6 && spot.x <= frame.right + 6 && off(spot) <= reach);
      return seen.sort((one, other) => off(one) - off(other))[0];
    }

    /* The next point along the axis; off the zoomed part it is left out. */
    step(pane, by) {
      const { frame } = pane, bars = this.spec.kind === "bars";
      const order = pane.spots.filter((spot) => !spot.grey && (bars || (spot.x >= frame.left - 6 && spot.x <= frame.right + 6)));
      if (!order.length) return;
      if (!bars) order.sort((one, other) => one.x - other.x);
      const now = order.findIndex((spot) => spot.index === pane.picked);
      const next = by === -Infinity ? 0 : by === Infinity ? order.length - 1 : now < 0 ? 0 : Math.max(0, Math.min(order.length - 1, now + by));
      this.pick(pane, order[next].index, true);
    }

    toChannel(pane, by) {
      const others = this.visible().filter((one) => one.way === pane.way);
      const next = others[others.indexOf(pane) + by];
      if (!next) return;
      next.picked = pane.picked;
      next.svg.focus();
    }

    /* Goes by the key that was pressed; returns whether the key means something here. */
    key(pane, key) {
      const bars = this.spec.kind === "bars", steps = { ArrowLeft: -1, ArrowRight: 1, Home: -Infinity, End: Infinity };
      if (key in steps) this.step(pane, steps[key]);
      else if (key === "ArrowUp" || key === "ArrowDown") {
        const by = key === "ArrowUp" ? -1 : 1;
        if (bars) this.step(pane, by); else this.toChannel(pane, by);
      } else if (key === "+" || key === "=") this.zoomBy(1 / STEP);
      else if (key === "-") this.zoomBy(STEP);
      else if (key === "0") this.reset();
      else if (key === "Escape") { this.unlabel(pane); pane.picked = -1; this.said.textContent = ""; } else return false;
      return true;
    }

    listen(pane) {
      const { svg } = pane;
      let from = null, to = null;
      const at = (event) => {
        const box = svg.getBoundingClientRect(), scale = pane.frame ? pane.frame.width / box.width : 1;
        return { x: (event.clientX - box.left) * scale, y: (event.clientY - box.top) * scale };
      };
      const dragged = () => from && to && Math.hypot(to.x - from.x, to.y - from.y) > DRAGGED;
      const relabel = () => { if (document.activeElement === svg && pane.picked >= 0) this.pick(pane, pane.picked); else this.unlabel(pane); };
      svg.addEventListener("pointerdown", (event) => {
        if (event.button || !event.isPrimary || !pane.frame) return;
        from = at(event);
        to = null;
        svg.setPointerCapture(event.pointerId);
      });
      svg.addEventListener("pointermove", (event) => {
        if (!pane.frame) return;
        if (from) { to = at(event); if (dragged()) this.showBox(pane, from, to); return; }
        const spot = this.nearest(pane, at(event), event.pointerType);
        if (spot) drawLabel(pane, spot); else relabel();
      });
      svg.addEventListener("pointerup", (event) => {
        if (!from) return;
        const [start, end] = [from, to || from], far = dragged();
        from = to = null;
        if (far) { this.zoomTo(pane, start, end); return; }
        const spot = this.nearest(pane, at(event), event.pointerType);
        if (spot && !spot.grey) this.pick(pane, spot.index, true); else if (spot) this.said.textContent = drawLabel(pane, spot).join("; ");
      });
      svg.addEventListener("pointercancel", () => { from = to = null; relabel(); });
      svg.addEventListener("pointerleave", () => { if (!from) relabel(); });
      svg.addEventListener("dblclick", () => this.reset());
      svg.addEventListener("focus", () => {
        if (from || !pane.frame) return;
        if (pane.picked < 0) this.step(pane, this.spec.newest ? Infinity : -Infinity); else this.pick(pane, pane.picked, true);
      });
      svg.addEventListener("blur", () => this.unlabel(pane));
      svg.addEventListener("keydown", (event) => {
        if (event.ctrlKey || event.metaKey || event.altKey || !pane.frame) return;
        if (this.key(pane, event.key)) event.preventDefault();
      });
    }

    showBox(pane, from, to) {
      const { frame } = pane, tall = Math.abs(from.y - to.y) > TALL && this.spec.kind !== "bars";
      const [x1, x2] = [from.x, to.x].sort((a, b) => a - b), [y1, y2] = tall ? [from.y, to.y].sort((a, b) => a - b) : [frame.top, frame.bottom];
      pane.svg.querySelector(".over").replaceChildren(el("rect", { class: "zoom-box", x: x1, y: y1, width: x2 - x1, height: y2 - y1 }));
    }
  }

  /* A range scaled about its middle; null where it holds the whole again. */
  const scaled = (range, whole, factor) => {
    const middle = (range[0] + range[1]) / 2, half = (range[1] - range[0]) / 2 * factor;
    return half >= (whole[1] - whole[0]) / 2 * 0.999 ? null : [middle - half, middle + half];
  };

  /* --- the live page ------------------------------------------------------------------------------------------------- */

  const judged = (p, of) => ({
    value: p.residual, u: p.u, angle: p.angle_deg, time: p.time_s, order: 1, group: p.installation, pass: p.pass, struck: p.struck, of,
    where: _(`installation ${p.installation}, pass ${p.pass}, point ${p.point}`),
  });
  const loadPrevious = async () => {
    const reply = await fetch("plots/previous", { headers: { accept: "application/json" } });
    const found = reply.ok ? await reply.json() : { run: "", points: [] };
    const points = found.points.map((p) => judged(p, _(`run ${found.run}`)));
    return { points, told: _("There is no earlier calibration of this unit.") };
  };

  let live = null;
  const previous = { name: _("previous run"), load: loadPrevious };
  /* Shows the residuals from predictions of a run in progress. */
  const show = (place, points, k) => {
    place.hidden = points.length === 0;
    if (!points.length) return;
    const spec = {
      title: _("Residuals against prediction"), kind: "band", channels: ["x", "y", "z"], unit: points[points.length - 1].unit, k, newest: true,
      ways: ["angle", "time"], sets: [{ name: "", points: points.map((p) => judged(p, "")) }], grey: previous, table: "plots/live",
    };
    if (live) live.show(spec); else live = new Chart(place.querySelector("[data-chart]"), spec);
    place.dataset.newest = points[points.length - 1].n;
  };

  /* How many values of all channels lie outside their bands, and how many do by chance (normal, two-sided). */
  const outside = (points, k) => {
    const standing = points.filter((p) => !p.struck), channels = [0, 1, 2];
    const values = standing.length * channels.length;
    const found = standing.reduce((sum, p) => sum + channels.filter((i) => Math.abs(p.residual[i]) > k * p.u[i]).length, 0);
    return { values, outside: found, expected: Math.round(values * BY_CHANCE(k)) };
  };
  return { Chart, show, outside };
})();
