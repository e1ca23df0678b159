// The closed loops of a page: their modules, parameters, sliders and runs.  It draws nothing and
// needs no document.  The parameters in a module's memory are the only copy of a loop's numbers:
// a run and the sliders both read them there.
class Loops {
  // described: name -> {wasm, table}.  requested: a function from a parameter's path to its text in
  // the page's address, or null.
  constructor(described, requested) {
    this.described = described;
    this.requested = requested;
    this.modules = new Map();
  }

  names() {
    return Object.keys(this.described);
  }

  has(name) {
    return Object.hasOwn(this.described, name);
  }

  opened(name) {
    if (!this.modules.has(name)) this.modules.set(name, this.loaded(this.described[name]));
    return this.modules.get(name);
  }

  loaded({wasm, table}) {
    const bytes = Uint8Array.from(atob(wasm), c => c.charCodeAt(0));
    const loop = new WebAssembly.Instance(new WebAssembly.Module(bytes), {}).exports;
    const Reals = table.bytes === 4 ? Float32Array : Float64Array;
    loop._initialize();
    loop.defaults();
    new Reals(loop.memory.buffer, loop.settings(), table.settings.length).set(table.settings);
    const parameters = new Reals(loop.memory.buffer, loop.parameters(), table.count);
    for (const each of this.controlled(table)) {
      const text = this.requested(each.key);
      if (this.isUsed(each, text)) for (const k of each.places) parameters[k] = Number(text);
    }
    return {loop, table, Reals, parameters};
  }

  // Whether the text of the address is a number that a slider may have.
  isUsed(each, text) {
    const value = Number(text);
    const isNumber = text !== null && text.trim() !== "" && Number.isFinite(value);
    return isNumber && (!each.positive || value > 0);
  }

  // Of some names of the address, those that set nothing in a loop.
  unused(name, names) {
    const sliders = new Map(this.controlled(this.opened(name).table).map(each => [each.key, each]));
    return names.filter(each => !sliders.has(each) || !this.isUsed(sliders.get(each), this.requested(each)));
  }

  // What has a slider: its key in the address, its words, the places of its numbers among the parameters, its range.
  controlled(table) {
    const found = [];
    for (const p of table.parameters.filter(p => p.slider)) {
      const size = p.shape.reduce((product, length) => product * length, 1);
      const all = Array.from({length: size}, (_, k) => p.offset + k);
      const separate = all.map((place, i) => [p.path + "[" + i + "]", p.words + ", " + table.names[i], [place]]);
      const sets = p.each ? separate : [[p.path, p.words, all]];
      const units = p.unit.split(", ");  // one, or one a component
      sets.forEach(([key, words, places], i) => {
        const [low, high] = p.slider[Math.min(i, p.slider.length - 1)];
        found.push({key, words, group: p.group, places, low, high, unit: units.length === size ? units[i] : p.unit, positive: p.positive});
      });
    }
    return found;
  }

  // The sliders of a loop with the numbers that its next run will use.  Where a number is outside
  // of its range, the range is widened.
  sliders(name) {
    const {table, parameters} = this.opened(name);
    return this.controlled(table).map(each => {
      const values = each.places.map(k => parameters[k]);
      const low = Math.min(each.low, ...values), high = Math.max(each.high, ...values);
      return {...each, values, low, high};
    });
  }

  set(name, places, value) {
    const {parameters} = this.opened(name);
    for (const k of places) parameters[k] = value;
  }

  // Gives a loop the numbers again that it had when the page was opened.
  reset(name) {
    this.modules.delete(name);
  }

  // Runs a loop with its parameters as they are: columns by name, a number for each record.
  run(name, steps, every) {
    const {loop, table, Reals} = this.opened(name);
    loop.start();
    const rows = loop.run(steps + 1, every);
    const all = new Reals(loop.memory.buffer, loop.records(), rows * table.record);
    const found = {rows, t: Array.from({length: rows}, (_, k) => k * every * table.settings[0])};
    const columnAt = place => Array.from({length: rows}, (_, k) => all[k * table.record + place]);
    for (const {name: column, offset, size} of table.records)
      found[column] = Array.from({length: size}, (_, i) => columnAt(offset + i));
    return found;
  }

  // Where a run is outside of its bounds: a component, the side, the first recorded time there, and the first one inside again (null: it stays outside).
  outside(name, found) {
    const {table} = this.opened(name);
    const sides = [["above its upper bound", (q, i, k) => q > found.upper[i][k]], ["below its lower bound", (q, i, k) => q < found.lower[i][k]]];
    const places = [];
    for (let i = 0; i < table.joints; i++) for (const [words, isOutside] of sides) {
      const first = found.q[i].findIndex((q, k) => isOutside(q, i, k));
      if (first < 0) continue;
      const back = found.q[i].findIndex((q, k) => k > first && !isOutside(q, i, k));
      places.push({joint: i, words, from: found.t[first], to: back < 0 ? null : found.t[back]});
    }
    return places;
  }
}
