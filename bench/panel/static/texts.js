"use strict";
/* Texts of scripts in the language of the page, found as bench/base/languages.py finds them; without a catalogue, English. */
const _ = (() => {
  const told = window.BENCH_TEXTS;
  if (!told) return (text) => text;
  const BLANK = /\{(\d+)\}/, UNITS = new Set(told.units), INSTRUMENTS = new Set(told.instruments);
  const AROUND = new RegExp(`^${told.patterns.around}$`, "su"), SENTENCE = new RegExp(told.patterns.sentence, "u");
  const CLAUSE = new RegExp(told.patterns.clause, "u"), WORD = new RegExp(told.patterns.word, "gu");
  const TYPED = new RegExp(told.patterns.typed, "gu");  // values of blanks in a command or path stay as they are
  const rules = new Intl.PluralRules(told.language), FORMS = { one: 0, few: 1, many: 2, other: 1 };
  const letters = (text) => text.replace(/\{\d+\}/g, "").replace(/[^\p{L}\d]/gu, "").length;
  const patternOf = (text) => {
    const names = [];
    const source = text.split(BLANK).map((part, at) => {
      if (at % 2 === 0) return part.replace(/[.*+?^${}()|[\]\\/]/g, "\\$&");
      names.push(part);
      return "(.*?)";
    }).join("");
    const typed = new Set((text.match(TYPED) || []).flatMap((one) => [...one.matchAll(/\{(\d+)\}/g)].map((blank) => blank[1])));
    return { names, typed, pattern: new RegExp(`^${source}$`, "u") };
  };
  const exact = new Map(), filled = [];
  for (const [english, plural, forms] of told.texts) {
    for (const text of plural ? [english, plural] : [english]) {
      exact.set(text, forms);
      if (BLANK.test(text)) filled.push({ ...patternOf(text), forms, sure: letters(english), first: Number(english.startsWith("{")) });
    }
  }
  filled.sort((one, other) => one.first - other.first || other.sure - one.sure || other.names.length - one.names.length);

  const DECIMAL = /(?<![\p{L}\d_.])(\d+)\.(\d+)(?!\.?\d)(?![a-df-zA-DF-Z_])/gu;
  const number = (text) => text.replace(DECIMAL, `$1${told.decimal}$2`);
  const numeric = (text) => text.search(DECIMAL) >= 0 && (text.match(/\p{L}+/gu) || []).every((word) => UNITS.has(word));
  const fill = (forms, values) => {
    const count = Object.values(values).find((value) => /^\d+$/.test(value));
    const form = forms.length > 1 ? forms[FORMS[rules.select(Number(count === undefined ? 2 : count))]] : forms[0];
    return form.replace(/\{(\d+)\}/g, (whole, name) => (name in values ? values[name] : whole));
  };
  const named = (name) => (INSTRUMENTS.has(name) ? say(name) : name);  // the name of a run stays
  const known = (text) => (exact.has(text) ? fill(exact.get(text), {}) : null);
  const copied = (text, surely = true, single = undefined) => {
    for (const { names, typed, pattern, forms, sure, first } of filled) {
      if ((sure >= told.sure) !== surely) continue;
      const found = pattern.exec(text);
      if (found && first && found.slice(1).slice(0, single).some((value) => CLAUSE.test(value))) continue;
      if (!found || (!surely && found.slice(1).some((value) => value.length > told.short || foreign(value)))) continue;
      return fill(forms, Object.fromEntries(names.map((name, at) => [name, typed.has(name) ? found[at + 1] : say(found[at + 1])])));
    }
    return null;
  };
  const part = (text) => {
    if (numeric(text)) return /\p{L}/u.test(text) ? number(text) : text;
    const whole = known(text) || copied(text) || copied(text, false);
    const colon = text.indexOf(": ");
    if (whole || colon < 0 || text.slice(0, colon).includes(" ")) return whole || text;
    const rest = text.slice(colon + 2), told = part(rest);  // an instrument and its fault
    return told === rest ? text : `${named(text.slice(0, colon))}: ${told}`;
  };
  const foreign = (text) => (text.match(WORD) || []).some((word) => !UNITS.has(word)) && part(text) === text;
  const settled = (text) => !text.trim().includes(" ") || !foreign(text);
  const upper = (text) => text.slice(0, 1).toUpperCase() + text.slice(1);
  const seen = new Map();
  const say = (text) => {
    if (typeof text !== "string" || !text) return text;
    if (!seen.has(text)) {
      if (seen.size > 5000) seen.clear();
      seen.set(text, found(text));
    }
    return seen.get(text);
  };
  const lastClause = (text) => {
    const at = text.lastIndexOf("; "), last = text.slice(at + 2), told = part(last);
    return at >= 0 && told !== last ? `${say(text.slice(0, at))}; ${told}` : null;
  };
  const fault = (text) => {  // a fault, an entry, after the names of instrument or file
    const at = text.indexOf(": "), rest = text.slice(at + 2);
    if (at < 0 || text.slice(0, at).includes(" ")) return null;
    const told = known(rest) || copied(rest) || fault(rest);
    return told && `${named(text.slice(0, at))}: ${told}`;
  };
  const found = (text) => {
    if (numeric(text)) return number(text);
    const lowered = text.slice(0, 1).toLowerCase() + text.slice(1);
    for (const look of [known, (one) => copied(one)]) {
      const whole = look(text);
      if (whole !== null) return whole;
      const small = lowered === text ? null : look(lowered);
      if (small !== null) return upper(small);
    }
    for (const joint of ["\n", "  "]) {
      if (text.includes(joint)) return text.split(joint).map(say).join(joint);
    }
    const clause = fault(text) || lastClause(text);
    if (clause) return clause;
    const end = text.search(SENTENCE);  // the rest may be an entry of several sentences
    if (end >= 0) return `${say(text.slice(0, end))} ${say(text.slice(end + 1))}`;
    const around = AROUND.exec(text);
    if (around) {
      let [, before, inner, after] = around;
      if (inner.split("(").length > inner.split(")").length && after.includes(")")) {  // a bracket opened in the text
        const close = after.indexOf(")") + 1;
        [inner, after] = [inner + after.slice(0, close), after.slice(close)];
      }
      if (inner !== text) return before + say(inner) + after;
    }
    for (const joint of ["; ", ": ", ", "]) {
      const parts = text.split(joint);
      const whole = parts.every(settled) ? parts.map(part).join(joint) : text;
      if (whole !== text) return whole;
    }
    return copied(text, true, 1) || copied(text, true, 0) || part(text);
  };
  return say;
})();
