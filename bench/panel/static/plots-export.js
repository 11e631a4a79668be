"use strict";
/* A chart as a picture: one SVG of all plots that are shown, or the same drawn on a canvas as PNG. Nothing leaves the browser. */
const BenchPicture = (() => {
  const NS = "http://www.w3.org/2000/svg";
  const GAP = 12, HEAD = 30, LINE = 20, SHARP = 2;
  const PAINT = ["fill", "fill-opacity", "stroke", "stroke-opacity", "stroke-width", "stroke-dasharray"], FONT = ["font-size", "font-weight", "font-family"];

  const el = (name, attributes, text) => {
    const made = document.createElementNS(NS, name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== undefined) made.textContent = text;
    return made;
  };

  /* A copy with the colours of the page written into it; labels and boxes of the moment stay behind. */
  const painted = (original) => {
    if (original.classList.contains("over")) return null;
    const copy = original.cloneNode(false);
    copy.removeAttribute("class");
    const style = getComputedStyle(original);
    const names = { g: [], clipPath: [], text: [...PAINT, ...FONT] }[original.localName] || PAINT;
    for (const name of names) copy.setAttribute(name, style.getPropertyValue(name));
    for (const child of original.childNodes) {
      const inner = child.nodeType === Node.TEXT_NODE ? child.cloneNode() : painted(child);
      if (inner) copy.append(inner);
    }
    return copy;
  };

  /* All plots of a chart that are shown, each below its words, in one SVG with a title. */
  const svgOf = (chart) => {
    const page = getComputedStyle(document.body), ink = page.color, family = page.fontFamily;
    const paper = page.backgroundColor === "rgba(0, 0, 0, 0)" ? "#fff" : page.backgroundColor;
    const text = (x, y, words, size, weight) => el("text", { x, y, fill: ink, "font-size": `${size}px`, "font-weight": weight, "font-family": family }, words);
    const legend = chart.legend.textContent, parts = [];
    let top = HEAD, wide = 300;
    if (legend) { parts.push(text(8, top + 14, legend, 12, 400)); top += LINE; }
    for (const figure of new Set(chart.visible().map((pane) => pane.figure))) {
      const panes = chart.visible().filter((pane) => pane.figure === figure);
      parts.push(text(8, top + 14, panes[0].told.textContent, 12, 600));
      top += LINE;
      let left = 0, high = 0;
      for (const pane of panes) {
        const place = el("g", { transform: `translate(${left} ${top})` });
        for (const child of pane.svg.children) { const copy = painted(child); if (copy) place.append(copy); }
        parts.push(place);
        left += pane.frame.width + GAP;
        high = Math.max(high, pane.frame.height);
      }
      wide = Math.max(wide, left);
      top += high + GAP;
    }
    const root = el("svg", { xmlns: NS, width: Math.ceil(wide), height: Math.ceil(top), viewBox: `0 0 ${Math.ceil(wide)} ${Math.ceil(top)}` });
    root.append(el("rect", { x: 0, y: 0, width: wide, height: top, fill: paper }), text(8, 20, titleOf(chart), 15, 700), ...parts);
    return root;
  };

  const titleOf = (chart) => [chart.run + (chart.place.closest("[data-simulated]") ? " (SIMULATED)" : ""), chart.spec.title, chart.spec.sets.length > 1 ? chart.spec.sets[chart.chosen.set].name : ""].filter(Boolean).join(": ");

  /* --- on a canvas --------------------------------------------------------------------------------------------------- */

  const numberOf = (one, name) => parseFloat(one.getAttribute(name)) || 0;

  const pathOf = (one) => {
    const path = new Path2D(), n = (name) => numberOf(one, name);
    switch (one.localName) {
      case "rect": path.rect(n("x"), n("y"), n("width"), n("height")); return path;
      case "circle": path.arc(n("cx"), n("cy"), n("r"), 0, 2 * Math.PI); return path;
      case "line": path.moveTo(n("x1"), n("y1")); path.lineTo(n("x2"), n("y2")); return path;
      default: return new Path2D(one.getAttribute("d"));
    }
  };

  const brush = (one, name) => {
    const colour = one.getAttribute(name);
    if (!colour || colour === "none") return null;
    const opacity = one.getAttribute(`${name}-opacity`);
    return { colour, opacity: opacity === null ? 1 : Number(opacity) };
  };

  const drawText = (canvas, one) => {
    const turned = /rotate\(([-\d.]+) ([-\d.]+) ([-\d.]+)\)/.exec(one.getAttribute("transform") || "");
    if (turned) {
      const [angle, x, y] = turned.slice(1).map(Number);
      canvas.translate(x, y);
      canvas.rotate(angle * Math.PI / 180);
      canvas.translate(-x, -y);
    }
    canvas.font = `${one.getAttribute("font-weight")} ${one.getAttribute("font-size")} ${one.getAttribute("font-family")}`;
    canvas.textAlign = { middle: "center", end: "right" }[one.getAttribute("text-anchor")] || "left";
    canvas.textBaseline = one.getAttribute("dominant-baseline") === "central" ? "middle" : "alphabetic";
    canvas.fillStyle = one.getAttribute("fill");
    canvas.fillText(one.textContent, numberOf(one, "x"), numberOf(one, "y"));
  };

  const drawShape = (canvas, one) => {
    const path = pathOf(one), fill = brush(one, "fill"), stroke = brush(one, "stroke");
    if (fill) { canvas.globalAlpha = fill.opacity; canvas.fillStyle = fill.colour; canvas.fill(path); }
    if (stroke) {
      const dashes = (one.getAttribute("stroke-dasharray") || "").match(/[\d.]+/g);
      canvas.globalAlpha = stroke.opacity;
      canvas.strokeStyle = stroke.colour;
      canvas.lineWidth = parseFloat(one.getAttribute("stroke-width")) || 1;
      canvas.setLineDash(dashes ? dashes.map(Number) : []);
      canvas.stroke(path);
    }
  };

  const drawOn = (canvas, one, root) => {
    if (one.localName === "clipPath") return;
    canvas.save();
    if (one.localName === "g" || one.localName === "svg") {
      const moved = /translate\(([-\d.]+) ([-\d.]+)\)/.exec(one.getAttribute("transform") || "");
      if (moved) canvas.translate(Number(moved[1]), Number(moved[2]));
      const clip = /#([^)"]+)/.exec(one.getAttribute("clip-path") || "");
      if (clip) canvas.clip(pathOf(root.querySelector(`[id="${clip[1]}"] rect`)));
      for (const child of one.children) drawOn(canvas, child, root);
    } else if (one.localName === "text") drawText(canvas, one);
    else drawShape(canvas, one);
    canvas.restore();
  };

  const pngOf = (svg) => {
    const [width, height] = ["width", "height"].map((name) => numberOf(svg, name));
    const canvas = document.createElement("canvas");
    canvas.width = width * SHARP;
    canvas.height = height * SHARP;
    const on = canvas.getContext("2d");
    on.scale(SHARP, SHARP);
    drawOn(on, svg, svg);
    return new Promise((done) => { canvas.toBlob(done, "image/png"); });
  };

  /* Saves a chart under the run's name and the chart's. */
  const save = async (chart, form) => {
    const svg = svgOf(chart);
    const blob = form === "png" ? await pngOf(svg) : new Blob([`<?xml version="1.0" encoding="UTF-8"?>\n${new XMLSerializer().serializeToString(svg)}`], { type: "image/svg+xml" });
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    link.download = `${chart.run}-${chart.spec.table.split("/").pop()}.${form}`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  };
  return { svgOf, pngOf, save };
})();
