"use strict";
/* The plots of a finished run: asks for their numbers once, and makes a section for each. It computes no result of its own. */
(() => {
  const page = document.getElementById("plots-page");
  if (!page) return;
  const { made } = BenchDrawing;
  const here = page.dataset.here, XYZ = ["x", "y", "z"], BOTH = ["angle", "time"];

  let count = 0;
  const section = (title, told, spec) => {
    const one = made("section", undefined, "card plots"), head = made("h2", title), place = made("div");
    head.id = `plots-${count += 1}`;
    one.setAttribute("aria-labelledby", head.id);
    one.dataset.plots = spec.table.split("/").pop();
    place.dataset.chart = "";
    one.append(head, made("p", told, "soft"), place);
    document.getElementById("plots-sections").append(one);
    return new BenchPlots.Chart(place, { title, ...spec });
  };

  /* --- points as the drawing takes them ------------------------------------------------------------------------------ */

  const ofReading = (one, value, of, i) => ({
    value, u: one.u, angle: one.angle_deg, time: one.time_s, order: i + 1, group: one.installation, pass: one.pass, of,
    where: _(`installation ${one.installation}, pass ${one.pass}, point ${one.point}${one.series > 1 ? `, visit ${one.series}` : ""}`),
  });
  const ofResiduals = (told, of) => told.points.map((one, i) => ofReading(one, one.residual, of, i));
  const ofDelta = (points, of, beside = 0) => points.map((one, i) => ({
    value: [one.delta_g], u: [one.u], U: [one.U], angle: one.angle_deg, time: one.time_s === undefined ? null : one.time_s, order: i + 1,
    group: "Δg", pass: one.pass, passed: one.passed, of, beside, where: one.pass === null ? "" : _(`pass ${one.pass}, point ${one.point}`),
  }));
  const ofBar = (where, value, group) => ({ value: [value], u: null, angle: null, time: null, where, group });

  /* --- sections ------------------------------------------------------------------------------------------------------ */

  const residuals = (told) => {
    const { previous } = told, overlay = previous && previous.residuals;
    section(_("Residuals"), _("What the calibration leaves of each reading. The band is ± k·u of a single reading; “!” marks a reading outside it."), {
      kind: "band", channels: XYZ, unit: told.residuals.unit, k: told.k, ways: BOTH, table: `${here}/residuals`,
      sets: [{ name: "", points: ofResiduals(told.residuals, "") }],
      grey: overlay ? { name: _(`previous run ${previous.run}`), points: ofResiduals(overlay, _(`run ${previous.run}`)) } : null,
    });
  };

  const deltaG = (told) => {
    const { previous } = told, overlay = previous && previous.delta_g;
    section(_("Δg at the verification points"), _("The error of the modulus with its expanded uncertainty U, and the limits. “!” marks a point that is not accepted."), {
      kind: "whiskers", channels: ["Δg"], unit: "g", k: told.delta_g.points.length ? told.delta_g.points[0].k : told.k, limit: told.delta_g.limit_g, ways: BOTH,
      table: `${here}/delta-g`, sets: [{ name: "", points: ofDelta(told.delta_g.points, "") }],
      grey: overlay ? { name: _(`previous run ${previous.run}`), points: ofDelta(overlay.points, _(`run ${previous.run}`), 1) } : null,
    });
  };

  const ofModels = (told) => {
    const { unit, readings } = told.diagnosis.residuals, named = readings.some((one) => one.after);
    const points = (value, of = "") => readings.map((one, i) => ofReading(one, value(one), of, i));
    const less = (one, other) => one.map((value, i) => value - other[i]);
    const last = (one) => one.after || one.before;
    const supplied = _("what was found supplies");
    section(_("Diagnosis: residuals by model"), named ? _("Before: with the given model. After: with the effects found. The simulated bench has noise of the same size.") : _("Residuals with the given model, and of a simulated bench with noise of the same size."), {
      kind: "band", channels: XYZ, unit, k: told.k, ways: BOTH, table: `${here}/diagnosis`,
      sets: [{ name: _("before"), points: points((one) => one.before) }, ...(named ? [{ name: _("after"), points: points((one) => one.after) }] : []), { name: _("simulated bench"), points: points((one) => one.simulated) }],
      grey: named ? { name: supplied, points: points((one) => less(one.before, one.after), supplied) } : null,
    });
    const simulated = named ? _("simulated bench, with the effects found") : _("simulated bench, given model");
    section(_("Diagnosis: signals"), _("What was measured, and what the simulated bench gives at the same angles."), {
      kind: "signal", channels: XYZ, unit, k: told.k, ways: BOTH, table: `${here}/diagnosis`,
      sets: [{ name: _("measured"), points: points((one) => one.signal).map((one) => ({ ...one, u: null })) }],
      grey: { name: simulated, points: points((one) => less(one.signal, last(one)), simulated).map((one) => ({ ...one, u: null })) },
    });
  };

  const deltaOfModels = (told) => {
    const { before, after } = told.diagnosis.delta_g;
    const sets = [...(after ? [{ name: _("after"), points: ofDelta(after, "") }] : []), { name: _("before"), points: ofDelta(before, "") }];
    section(_("Diagnosis: Δg by model"), _("Δg at the verification points with ± 2·u, by the model before and after."), {
      kind: "whiskers", channels: ["Δg"], unit: "g", k: told.k, limit: told.delta_g ? told.delta_g.limit_g : 0, ways: BOTH, table: `${here}/diagnosis-delta-g`,
      sets, grey: after ? { name: _("before, in grey"), points: ofDelta(before, "before", 1) } : null,
    });
  };

  const heldOut = (folds) => {
    const points = folds.flatMap((one) => ["before", "after"].filter((name) => one[name] !== null).map((name) => ofBar(`${name}: ${one.what}`, one[name], name)));
    if (points.length) section(_("Diagnosis: held-out readings"), _("How far the other readings predict them: reduced χ², before and after. Noise alone gives 1, the dashed line."), {
      kind: "bars", channels: [_("reduced χ²")], unit: "", k: 2, ways: ["value"], axis: _("reduced χ² of held-out readings"), reference: 1, table: `${here}/held-out`, sets: [{ name: "", points }], grey: null,
    });
  };

  const ranking = ({ found, rivals }) => {
    const kind = (one) => (one.name === found ? "named" : one.tied ? "tied" : "less");
    section(_(`Diagnosis: ${found.replaceAll("_", " ")} and its rivals`), _("How plausible each name is. “tie” marks a name that the readings cannot separate from the first."), {
      kind: "bars", channels: [_("ln odds")], unit: "", k: 2, ways: ["value"], axis: _("ln odds that the effect is present"), table: `${here}/ranking`, grey: null,
      sets: [{ name: "", points: [...rivals].sort((a, b) => b.ln_odds - a.ln_odds).map((one) => ofBar(one.name.replaceAll("_", " "), one.ln_odds, kind(one))) }],
    });
  };

  const show = (told) => {
    if (told.residuals) residuals(told);
    if (told.delta_g && told.delta_g.points.length) deltaG(told);
    const { diagnosis } = told, trouble = [...told.trouble];
    if (diagnosis) {
      if (diagnosis.residuals) ofModels(told);
      if (diagnosis.older) trouble.push(_("The result of the diagnosis has no residuals: diagnose the run again to plot them."));
      if (diagnosis.delta_g && diagnosis.delta_g.before.length) deltaOfModels(told);
      heldOut(diagnosis.held_out);
      diagnosis.ranking.forEach(ranking);
    }
    document.getElementById("plots-trouble").replaceChildren(...trouble.map((words) => made("p", words, "note bad")));
    page.dataset.shown = String(count);
    document.getElementById("plots-state").textContent = count ? "" : _("There is nothing to plot.");
  };

  const ask = async () => {
    const state = document.getElementById("plots-state");
    try {
      const reply = await fetch(`${here}/data`, { headers: { accept: "application/json" } });
      const told = await reply.json();
      if (reply.ok) show(told); else state.textContent = `✗ ${_(told.problem)}`;
    } catch { state.textContent = _("✗ No connection to the panel: load the page again."); }
  };
  ask();
})();
