"use strict";
/* The live page of a run: shows what the server sends, sends what a person answers and wishes. It keeps no truth of its own. */
(() => {
  const live = document.getElementById("live");
  if (!live) return;
  const $ = (id) => document.getElementById(id);
  const { made } = BenchDrawing;
  const me = { name: live.dataset.person, role: live.dataset.role, csrf: live.dataset.csrf };
  const LATE_S = 5, OPEN_AGAIN_S = 7, SOON = 120;
  const MARKS = { ready: "○", running: "▶", paused: "❚❚", finished: "✓", failed: "✗", interrupted: "■", aborted: "✗", dead: "✗" };

  let state = JSON.parse(live.dataset.state);
  let points = [], kOfBand = 2;
  let heard = performance.now();      /* when the server was heard last */
  let offset = Date.parse(state.now) - Date.now();
  let source = null, opened = 0, gone = "";
  let sentFor = "";                   /* the question that was answered here and still stands */
  let shownPrompt = null, shownDrawing = "";
  let checkTimer = 0, checkNumber = 0, sureOf = "";
  let held = false;                   /* whether this person was in control */
  let called = "", outcomeAsked = 0;  /* the question that was announced; how often the outcome was asked for */
  let heardTaken = (state.answered || {}).id;  /* the last answer of an encoder that was told by a tone */

  const put = (id, told) => { const at = $(id), text = _(told); if (at.textContent !== text) at.textContent = text; };
  const show = (id, shown) => { $(id).hidden = !shown; };
  const seconds = (s) => {
    if (s >= 3600) return _(`${Math.floor(s / 3600)} h ${String(Math.floor(s % 3600 / 60)).padStart(2, "0")} min`);
    if (s >= 60) return _(`${Math.floor(s / 60)} min ${String(Math.floor(s % 60)).padStart(2, "0")} s`);
    return `${Math.floor(s)} s`;
  };
  const now = () => Date.now() + offset;
  const clock = (iso) => new Date(iso).toLocaleTimeString([], { hour12: false, hour: "2-digit", minute: "2-digit", second: "2-digit" });

  /* --- who may do what: the server decides, the page only shows it ----------------------------------------------- */

  const WISHES = document.querySelectorAll("#stopping button, #wishes button");
  const holder = () => (state.control || {}).holder || "";
  const holding = () => me.role !== "viewer" && holder() === me.name;
  const lost = () => (performance.now() - heard) / 1000 > LATE_S || gone !== "";

  const showControl = () => {
    const control = state.control || {}, asking = control.asking || [];
    show("who", !state.ended);
    put("who", holding() ? _("You are in control") : holder() ? _(`${holder()} is in control`) : _("Nobody is in control"));
    $("control").parentElement.classList.toggle("asked", holding() && asking.length > 0 && !state.ended);
    const key = JSON.stringify([control, state.ended]);
    if ($("control").dataset.key === key) return;
    $("control").dataset.key = key;
    const offered = [];
    const button = (label, act, to) => {
      const one = made("button", label);
      one.type = "button";
      one.addEventListener("click", () => post("control", to ? { do: act, to } : { do: act }));
      offered.push(one);
    };
    if (me.role !== "viewer" && !state.ended) {
      if (holding()) {
        for (const name of asking) {
          offered.push(made("strong", _(`${name} asks for control`), "name"));
          button(_(`Give it to ${name}`), "grant", name);
          button(_("Keep it"), "deny", name);
        }
        button(_("Let go of control"), "release");
      } else if (!holder()) button(_("Take control"), "take");
      else {
        if (asking.includes(me.name)) offered.push(made("span", _(`${holder()} is asked for it`), "soft"));
        else button(_("Ask for control"), "ask");
        if ((control.denied || []).includes(me.name)) offered.push(made("span", _(`${holder()} keeps it`), "soft"));
        if (me.role === "supervisor") button(_("Take over by force"), "force");
      }
    }
    const focused = $("control").contains(document.activeElement), gained = holding() && !held;
    held = holding();
    $("control").replaceChildren(...offered);
    if (gained && (focused || document.activeElement === document.body) && !$("typing").hidden) $("typed").focus();
    else if (focused && offered.length) offered[0].focus();
  };

  const allow = () => {
    const cut = lost(), going = state.alive && !state.ended;
    for (const button of WISHES) {
      const wish = button.dataset.wish;
      const heardIn = wish === "pause" ? state.state === "running" : wish === "continue" ? state.state === "paused" : wish.startsWith("redo") ? state.redo !== "" : wish === "skip" ? !state.doubt && (state.prompt || {}).do !== "mount" : true;
      button.disabled = cut || !going || !heardIn || (wish !== "stop" && !holding());
      if (wish === "pause") button.hidden = state.state === "paused";
      if (wish === "continue") button.hidden = state.state !== "paused";
    }
    show("wishes", going);
    show("stopping", going);
    show("look-back", state.ended);
    show("controls", going || state.to_do.length > 0);
    show("resume", !state.alive && !state.ended && me.role !== "viewer");
    $("resume-button").disabled = $("alarm-resume").disabled = cut || (holder() && !holding());
    const may = holding() && !cut && state.prompt && sentFor !== state.prompt.id;
    for (const button of $("buttons").querySelectorAll("button")) button.disabled = !may;
    $("typed").readOnly = !may;
  };

  /* --- the question ------------------------------------------------------------------------------------------------ */

  const draw = (text) => {
    if (text === shownDrawing) return;
    shownDrawing = text;
    show("drawing", text !== "");
    if (!text) { $("drawing").replaceChildren(); return; }
    const parsed = new DOMParser().parseFromString(text, "image/svg+xml").documentElement;
    for (const one of parsed.querySelectorAll("text")) one.textContent = _(one.textContent);
    if (parsed.hasAttribute("aria-label")) parsed.setAttribute("aria-label", _(parsed.getAttribute("aria-label")));
    $("drawing").replaceChildren(document.importNode(parsed, true));
  };

  const askedAnew = (prompt) => {
    const typed = $("typed"), old = shownPrompt, sent = sentFor !== "";
    const same = old && prompt && stepOf(old.id) === stepOf(prompt.id);  /* the same step asks again */
    shownPrompt = prompt;
    sentFor = "";
    const wants = prompt && (prompt.kind === "angle" || prompt.kind === "number");
    if (!same) typed.value = draftFor(prompt);
    show("typing", Boolean(wants));
    if (!prompt) { $("buttons").replaceChildren(); return; }
    show("signs", prompt.kind === "angle" && matchMedia("(pointer: coarse)").matches);
    put("typed-label", prompt.kind === "angle" ? _("Angle read on the scale") : prompt.unit ? _(`Value in ${prompt.unit}`) : _("Value"));
    typed.placeholder = prompt.kind === "angle" ? "45 00 10" : "";
    const buttons = prompt.buttons.map((of, i) => {
      const one = made("button", of.label, i === 0 ? "primary huge" : "");
      one.type = i === 0 && of.text === "" ? "submit" : "button";
      if (one.type === "button") one.addEventListener("click", () => ("begin" in of ? begin(of.begin) : answer(of.text)));
      return one;
    });
    if (wants && !prompt.enter) {
      const one = made("button", _("Answer"), "primary huge");
      one.type = "submit";
      buttons.unshift(one);
    }
    const inside = $("answer").contains(document.activeElement) || [document.body, $("main"), $("todo")].includes(document.activeElement);
    $("buttons").replaceChildren(...buttons);
    if (inside) (wants ? typed : prompt.enter && buttons.length ? buttons[0] : $("todo")).focus({ preventScroll: true });
    if (same && sent) typed.select();  /* what was refused: typing replaces it */
    check();
  };

  const begin = (words) => {
    show("typing", true);
    put("typed-label", _("Answer, with the reason"));
    $("typed").value = words;
    $("typed").focus();
    check();
  };

  /* What is half typed survives a reload of the page and a pause, until a question is answered. */
  const DRAFT = `draft:${location.pathname}:`;
  const stepOf = (id) => id.split("#")[0], eventOf = (id) => Number(id.split("@").pop());
  const drafts = () => Object.keys(sessionStorage).filter((key) => key.startsWith(DRAFT));
  const draftFor = (prompt) => {
    const key = drafts()[0] || "", asked = key.slice(DRAFT.length), answered = (state.answered || {}).id || "";
    const counts = answered.startsWith("pause@") || eventOf(answered) < eventOf(asked);
    if (!counts) sessionStorage.removeItem(key);
    return counts && prompt && stepOf(asked) === stepOf(prompt.id) ? sessionStorage.getItem(key) || "" : "";
  };
  const keepDraft = () => {
    if (!shownPrompt) return;
    for (const key of drafts()) sessionStorage.removeItem(key);
    if ($("typed").value) sessionStorage.setItem(DRAFT + shownPrompt.id, $("typed").value);
  };

  const label = () => {
    /* Enter is the default as long as nothing is typed; with something typed it is that. */
    const submit = $("buttons").querySelector("button[type=submit]");
    if (!submit || !shownPrompt || !shownPrompt.enter) return;
    const typed = $("typed").value.trim();
    const text = typed && !$("typing").hidden ? _(`Answer ${typed}`) : shownPrompt.buttons[0].label;
    if (submit.textContent !== text) submit.textContent = text;
  };

  const check = () => {
    clearTimeout(checkTimer);
    label();
    const text = $("typed").value, number = ++checkNumber;
    if (!shownPrompt || $("typing").hidden || !text.trim()) { told("", ""); return; }
    checkTimer = setTimeout(async () => {
      try {
        const reply = await fetch(`check-answer?${new URLSearchParams({ id: shownPrompt.id, text })}`, { headers: { accept: "application/json" } });
        if (number !== checkNumber || !reply.ok) return;
        const found = await reply.json();
        if (found.problem) told(`✗ ${_(found.problem)}`, "bad");
        else told(found.understood ? `✓ ${_(found.understood)}` : "✓", "good");
      } catch { /* the loss of connection shows elsewhere */ }
    }, 120);
  };

  const told = (text, kind) => {
    put("checked", text);
    $("checked").className = `checked ${kind}`;
  };

  const answer = async (text) => {
    if (!shownPrompt || sentFor === shownPrompt.id) return;
    const id = shownPrompt.id;
    clearTimeout(checkTimer);
    sentFor = id;
    allow();
    const taken = await post("answer", { id, text });
    if (!taken && sentFor === id) { sentFor = ""; $("typed").select(); }
    allow();
  };

  $("answer").addEventListener("submit", (event) => {
    event.preventDefault();
    if (!shownPrompt) return;
    const text = $("typing").hidden ? "" : $("typed").value.trim();
    if (text || shownPrompt.enter) { answer(text); return; }
    told(shownPrompt.kind === "angle" ? _("✗ Nothing was typed: read the scale and type the angle.") : _("✗ Nothing was typed."), "bad");
    $("typed").focus();
  });
  $("typed").addEventListener("input", () => { keepDraft(); check(); });
  for (const button of $("signs").querySelectorAll("button")) {
    button.addEventListener("click", () => {
      const typed = $("typed");
      typed.setRangeText(button.dataset.sign, typed.selectionStart, typed.selectionEnd, "end");
      typed.focus();
      typed.dispatchEvent(new Event("input"));
    });
  }

  /* --- what is sent ------------------------------------------------------------------------------------------------ */

  const say = (text, kind) => {
    put("message", text);
    $("message").className = `note ${kind || ""}`;
    show("message", text !== "");
  };

  const post = async (to, body) => {
    try {
      const reply = await fetch(to, {
        method: "POST",
        headers: { "content-type": "application/json", accept: "application/json", "x-csrf": me.csrf },
        body: JSON.stringify(body),
      });
      const found = await reply.json().catch(() => ({}));
      if (reply.ok) { say("", ""); return true; }
      say(found.problem || found.why || found.error || found.text || found.detail || _(`The panel refused this (${reply.status}).`), "bad");
    } catch {
      say(_("The connection is down, and nothing was sent. Try again once it is back."), "bad");
    }
    return false;
  };

  const AGAIN = { abort: [_("Give up the run"), () => _("Give it up for good: press again")], redo: [_("Redo the point"), () => _(`Redo ${state.redo}: press again`)],
    "redo-pass": [_("Redo the pass"), () => _("All points of this pass again: press again")] };
  for (const button of WISHES) {
    button.addEventListener("click", () => {
      const wish = button.dataset.wish, reason = ["skip", "abort"].includes(wish) ? $("reason").value.trim() : "";
      if (["skip", "abort"].includes(wish) && !reason) { say(_("Type the reason beside it first."), "bad"); $("reason").focus(); return; }
      if (wish in AGAIN && sureOf !== wish) {
        const [calm, asked] = AGAIN[wish];
        sureOf = wish;
        button.textContent = asked();
        setTimeout(() => { if (sureOf === wish) sureOf = ""; button.textContent = calm; }, 6000);
        return;
      }
      sureOf = "";
      post("wish", { wish, reason }).then((taken) => {
        if (!taken) return;
        $("reason").value = "";
        if (document.activeElement === button) button.blur();  /* the question that follows is typed at once */
      });
    });
  }
  $("reasoned").addEventListener("submit", (event) => event.preventDefault());
  for (const id of ["resume-button", "alarm-resume"]) {
    $(id).addEventListener("click", async () => {
      say(_("The program that resumes the run is being started …"), "open");
      if (await post("resume", {})) say(_("The instruments are being opened …"), "open");
    });
  }

  /* --- a call for the person: sound where it is switched on, else a flash; the screen stays awake ------------------- */

  let audio = null, awake = null;
  const soundOn = () => $("sound").getAttribute("aria-pressed") === "true";
  const ASKED = [[0, 880], [0.25, 1175]], TAKEN = [[0, 587]];
  const beep = (tones) => {
    for (const [at, hertz] of tones) {
      const tone = audio.createOscillator(), gain = audio.createGain();
      tone.frequency.value = hertz;
      gain.gain.setValueAtTime(0.2, audio.currentTime + at);
      gain.gain.exponentialRampToValueAtTime(0.001, audio.currentTime + at + 0.2);
      tone.connect(gain).connect(audio.destination);
      tone.start(audio.currentTime + at);
      tone.stop(audio.currentTime + at + 0.2);
    }
  };
  const call = () => {
    if (soundOn() && audio) { audio.resume(); beep(ASKED); return; }
    $("now").classList.remove("flash");
    void $("now").offsetWidth;  /* the animation begins again */
    $("now").classList.add("flash");
  };
  const press = (id, on, words) => {
    $(id).setAttribute("aria-pressed", String(on));
    $(id).textContent = _(words);
  };
  $("sound").addEventListener("click", () => {
    const on = !soundOn();
    press("sound", on, on ? _("Sound on") : _("Sound off"));
    if (on) { audio = audio || new AudioContext(); call(); }
  });
  const makeBig = (on) => {
    document.body.classList.toggle("enlarged", on);
    press("big", on, on ? _("Normal") : _("Big"));
    localStorage.setItem("big", on ? "yes" : "");
  };
  $("big").addEventListener("click", () => {
    makeBig(!document.body.classList.contains("enlarged"));
    if (!$("answer").hidden && !$("typing").hidden) $("typed").focus();
  });
  if (localStorage.getItem("big")) makeBig(true);

  const stayAwake = async () => {
    if (state.ended || !holding()) { if (awake) { awake.release(); awake = null; } show("awake", false); return; }
    if (!("wakeLock" in navigator)) {
      show("awake", matchMedia("(pointer: coarse)").matches);
      put("awake", _("This device may darken its screen: lengthen the screen timeout in its settings."));
      return;
    }
    if (awake && !awake.released) return;
    try { awake = await navigator.wakeLock.request("screen"); } catch { awake = null; }
  };

  /* --- what is shown ----------------------------------------------------------------------------------------------- */

  const showState = () => {
    const word = !state.alive && ["ready", "running", "paused"].includes(state.state) ? "dead" : state.state;
    const waits = state.prompt && word !== "dead";
    const text = waits ? (holding() ? _("waits for you") : _("waits for an answer")) : word === "dead" ? _("no program") : word;
    if (state.alive && $("message").classList.contains("open")) say("", "");
    put("state", `${waits ? "?" : MARKS[word] || "○"} ${_(text)}`);
    $("state").className = `state ${waits ? "waiting" : word}`;
    document.title = _(`${state.prompt && holding() ? "● " : ""}${state.run}: ${text} – calibration bench`);

    const prompt = state.prompt;
    put("todo", prompt ? prompt.text : state.doing);
    $("todo").classList.toggle("small", (prompt ? prompt.text : state.doing).length > 140);
    show("target", Boolean(prompt && prompt.target));
    if (prompt && prompt.target) {
      put("target-angle", prompt.target.replace("°", "°\u200b"));  /* a narrow screen breaks it here */
      put("approach", prompt.direction > 0 ? _("↺ rising, from below") : _("↻ falling, from above"));
    }
    show("answer", Boolean(prompt));
    showLive(prompt ? latest : {});  /* a value may have come before its question */
    $("now").classList.toggle("asking", Boolean(prompt));
    draw(prompt ? prompt.drawing : "");
    if ((prompt || {}).id !== (shownPrompt || {}).id) askedAnew(prompt);
    if (prompt && holding() && called !== prompt.id) { called = prompt.id; call(); }
    const taken = state.answered || {};
    if (taken.id !== heardTaken && taken.by === "encoder" && holding() && soundOn() && audio) beep(TAKEN);
    heardTaken = taken.id;
    showAlarm();
    if (state.ended) askOutcome(); else if ($("end").firstElementChild) { $("end").replaceChildren(); outcomeAsked = 0; }
    show("todo", !state.ended || !$("end").textContent.trim());
    const notes = [];
    if (!state.alive && !state.ended && me.role !== "viewer" && holder() && !holding()) notes.push(_(`${holder()} is in control: ask for control, then resume.`));
    if (prompt && !holding()) notes.push(holder() ? _(`${holder()} answers here, or somebody at the terminal.`) : _("Take control to answer here; the terminal answers too."));
    if (state.unmet) notes.push(`${_(state.unmet)}.`);
    if (state.refused && state.refused.why) notes.push(_(`Not accepted: “${state.refused.answer}” – ${state.refused.why.replace(/\.$/, "")}.`));
    else if (state.answered) {
      const { answer, by, place } = state.answered;
      const who = place === "panel" ? _(`${by} in the panel`) : place === "terminal" ? _(`${by} at the terminal`) : by;
      notes.push(by ? _(`Last answer: “${answer}” by ${who}.`) : _(`Last answer: “${answer}”.`));
    }
    if (state.why && !state.alarm) notes.push(state.why);
    put("told", state.ended ? "" : notes.join(" "));

    const where = state.where;
    put("installation", where.installation ? `${where.installation}${where.series > 1 ? ` (visit ${where.series})` : ""}` : "–");
    put("pass", where.pass ? String(where.pass) : "–");
    put("point", where.point ? String(where.point) : "–");
    put("reading-count", `${where.reading} ${_("of")} ${where.readings}`);
    put("left", where.left || "–");
    show("left-part", !state.ended);
    put("now-title", state.ended ? _("Result") : _("Now"));
    $("done").value = where.done;
    put("steps", _(`step ${where.step || where.done} of ${where.steps}`));

    const angle = state.angle;
    put("commanded", angle ? `${angle.commanded} ${angle.direction === "rising" ? "↺" : "↻"}` : "–");
    put("read-back", angle && angle.read ? angle.read : "–");
    put("off", angle && angle.off ? angle.off : "–");

    showReading();
    show("chamber", Boolean(state.chamber && (state.chamber.set_c !== null || state.chamber.actual_c !== null)));
    if (state.chamber) {
      put("set-c", state.chamber.set_c === null ? "–" : `${state.chamber.set_c} °C`);
      put("actual-c", state.chamber.actual_c === null ? "–" : `${state.chamber.actual_c} °C${state.chamber.actual_time ? `, ${clock(state.chamber.actual_time)}` : ""}`);
      put("window", state.chamber.window || "");
    }
    show("soak", Boolean(state.soak));
    put("outside", outsideWords());
    list("warnings", state.warnings, (warning) => {
      const one = made("div", undefined, `note ${warning.stops ? "bad" : "open"}`);
      one.append(made("p", `⚠ ${_(warning.words)}`));
      if (warning.causes.length > 3) one.append(made("p", _(`all causes: ${warning.causes.join("; ")}`), "soft"));
      return one;
    });
    list("log", state.log, (line) => {
      const one = made("li");
      one.append(made("span", clock(line.time), "soft"), ` ${_(line.words)}`);
      if (line.by) one.append(" ", made("span", `(${line.by})`, "soft name"));
      return one;
    });
    list("to-do", state.to_do, (words) => made("li", _(`still to do: ${words}`)));
    live.dataset.events = state.events;
    live.dataset.prompt = prompt ? prompt.id : "";
    live.dataset.ended = state.ended;
    showControl();
    allow();
    stayAwake();
    tick();
  };

  const list = (id, items, each) => {
    const key = JSON.stringify(items);
    if ($(id).dataset.key === key) return;
    $(id).dataset.key = key;
    $(id).replaceChildren(...items.map(each));
  };

  const showAlarm = () => {
    const alarm = state.alarm;
    show("alarm", Boolean(alarm));
    if (!alarm) return;
    put("alarm-cause", `⚠ ${_(alarm.cause)}`);
    put("alarm-action", alarm.action);
    put("alarm-details", alarm.details);
    show("alarm-more", alarm.details !== "");
    show("alarm-resume", alarm.do === "resume" && me.role !== "viewer");
  };

  /* Marks in the plots and warnings speak of the same readings: some lie outside by chance, and that is no warning. */
  const outsideWords = () => {
    const told = BenchPlots.outside(points, kOfBand);
    const none = state.warnings.length ? "" : _("No early warning. ");
    if (!told.values) return none.trim();
    return none + _(`Outside ± ${kOfBand}·u: ${told.outside} of ${told.values} values; about ${told.expected} are expected by chance.`);
  };

  const askOutcome = async () => {
    const shown = $("outcome") ? $("outcome").dataset.outcome : "";
    const key = `${state.events} ${state.alive}`;
    if (askOutcome.busy || (askOutcome.key === key && shown !== "waiting")) return;
    if (shown === "ready" || shown === "none") { if (askOutcome.key === undefined) { askOutcome.key = key; return; } }
    askOutcome.busy = true;
    askOutcome.key = key;
    outcomeAsked += 1;
    try {
      const reply = await fetch("outcome");
      if (!reply.ok) return;
      const parsed = new DOMParser().parseFromString(await reply.text(), "text/html").getElementById("outcome");
      if (!parsed) return;
      $("end").replaceChildren(document.importNode(parsed, true));
      show("todo", !$("end").textContent.trim());
    } catch { /* the loss of connection is shown elsewhere */ } finally { askOutcome.busy = false; }
    if ($("outcome") && $("outcome").dataset.outcome === "waiting") setTimeout(askOutcome, outcomeAsked < SOON ? 1000 : 10_000);
  };

  const showReading = () => {
    const reading = state.reading;
    if (!reading) return;
    put("reading-words", _(`${reading.words}, ${reading.samples} samples, ${clock(reading.time)}`));
    put("rest", reading.rest);
    for (const channel of reading.channels) {
      const cells = document.querySelectorAll(`tr[data-channel="${channel.channel}"] td`);
      cells[0].textContent = _(channel.value);
      cells[1].textContent = _(channel.scatter);
      const drift = `${channel.steady === false ? "⚠ " : ""}${_(channel.drift)}${channel.outlier ? `; ⚠ ${_(channel.outlier)}` : ""}`;
      if (cells[2].textContent !== drift) cells[2].textContent = drift;
    }
  };

  /* --- the signals while one adjusts: the last minute, scaled to what they moved ------------------------------------- */

  const TRACE_S = 60, LEAST_SPAN_V = 2e-5;
  let trace = [], latest = {};
  const showLive = (value) => {
    const there = Boolean(value.time) && value.prompt === (state.prompt || {}).id;
    show("signals", there);
    if (!there) { trace = []; return; }
    if (value.time === live.dataset.shown) return;
    const seen = Boolean(value.signals_v);
    put("not-live", value.why || "");
    put("to-go", value.to_go || "");
    show("settled", seen && value.settled !== null);
    put("settled", value.settled ? _("✓ settled") : _("~ moving"));
    $("settled").className = `state ${value.settled ? "passed" : "waiting"}`;
    for (const row of document.querySelectorAll("[data-signal]")) row.hidden = !seen;
    if (!seen) return;
    const at = Date.parse(value.time) / 1000;
    if (trace.length && trace[0].prompt !== value.prompt) trace = [];
    trace.push({ at, volts: value.signals_v, prompt: value.prompt });
    trace = trace.filter((one) => at - one.at <= TRACE_S);
    for (const row of document.querySelectorAll("[data-signal]")) {
      const i = "xyz".indexOf(row.dataset.signal), values = trace.map((one) => one.volts[i]);
      const low = Math.min(...values), high = Math.max(...values), middle = (low + high) / 2, half = Math.max(high - low, LEAST_SPAN_V) / 2;
      const points = trace.map((one) => `${(300 - (at - one.at) / TRACE_S * 300).toFixed(1)} ${(20 - (one.volts[i] - middle) / half * 17).toFixed(1)}`);
      row.querySelector("path").setAttribute("d", `M${points.join("L")}`);
      const volts = `${value.signals_v[i] < 0 ? "−" : "+"}${Math.abs(value.signals_v[i]).toFixed(5)} V`;
      row.querySelector(".volts").textContent = _(volts);
      row.querySelector(".span").textContent = _(`moved ${((high - low) * 1e6).toFixed(0)} µV`);
    }
    live.dataset.shown = value.time;
  };

  /* --- the connection ---------------------------------------------------------------------------------------------- */

  const tick = () => {
    const silent = (performance.now() - heard) / 1000, cut = lost();
    document.body.classList.toggle("stale", cut);
    show("lost", cut);
    if (cut) put("lost", gone || _(`✗ No connection to the panel for ${seconds(silent)}: this page is out of date.`) + (state.alive && !state.ended ? ` ${_("The run continues.")}` : ""));
    const age = state.last_time ? _(`last event ${seconds(Math.max(0, (now() - Date.parse(state.last_time)) / 1000))} ago`) : _("no event yet");
    put("age", `${cut ? _("✗ not connected") : _("● connected")} · ${age}`);
    if (state.soak) {
      const left = state.soak.until ? Math.max(0, (Date.parse(state.soak.until) - now()) / 1000) : state.soak.left_s;
      put("soak-words", `${state.soak.words} (${state.soak.lasts})`);
      put("soak-left", _(`${seconds(left)} left`));
    }
    if (cut !== tick.cut) { tick.cut = cut; allow(); }
    if (silent > OPEN_AGAIN_S && (performance.now() - opened) / 1000 > OPEN_AGAIN_S) open();
  };

  const took = (event) => { heard = performance.now(); gone = ""; return event.data ? JSON.parse(event.data) : {}; };

  const open = () => {
    if (source) source.close();
    opened = performance.now();
    source = new EventSource("stream");
    source.addEventListener("state", (event) => {
      state = took(event);
      offset = Date.parse(state.now) - Date.now();
      showState();
    });
    source.addEventListener("points", (event) => {
      const sent = took(event);
      points = points.slice(0, sent.from).concat(sent.points);
      kOfBand = sent.k;
      BenchPlots.show($("plots"), points, kOfBand);
      put("outside", outsideWords());
    });
    source.addEventListener("live", (event) => { latest = took(event); showLive(latest); });
    source.addEventListener("beat", (event) => { took(event); tick(); });
    source.addEventListener("trouble", (event) => { gone = `✗ ${took(event).words}`; gone = gone || "✗"; source.close(); tick(); });
    source.addEventListener("error", async () => {
      if (source.readyState !== EventSource.CLOSED) return;
      const reply = await fetch("state", { headers: { accept: "application/json" } }).catch(() => null);
      if (reply && reply.status === 401) gone = _("✗ You are signed out: load the page again.");
      tick();
    });
  };

  showState();
  open();
  setInterval(tick, 500);
  document.addEventListener("visibilitychange", () => { if (!document.hidden) { tick(); stayAwake(); } });
})();
