// Runs the script of a live page with the least of a document that it needs.
// Called as: node live_page.js PAGE.html ACTIONS.json; prints one line of JSON for each action.
// An action is {"law": name}, which chooses a law, or {"move": path, "to": number}, which moves a slider, or
// {"reset": true}, which presses the button; {} does nothing.
"use strict";
const fs = require("fs");
const text = fs.readFileSync(process.argv[2], "utf8"), actions = JSON.parse(fs.readFileSync(process.argv[3], "utf8"));
// A browser ends a script element at the first "</script", and one that holds "<!--<script" later than that.
const script = text.slice(text.indexOf("<script>") + 8, text.indexOf("</script"));

class Element {
  constructor(tag) { Object.assign(this, {tag, children: [], listeners: {}, dataset: {}, textContent: "", className: "", style: {}}); }
  appendChild(part) { this.append(part); return part; }
  append(...parts) {
    this.words = parts.find(part => typeof part === "string") ?? "";
    this.children.push(...parts.filter(part => part instanceof Element));
  }
  replaceChildren() { this.children = []; }
  addEventListener(kind, does) { this.listeners[kind] = does; }
  getContext() { return new Proxy({}, {get: () => () => undefined, set: () => true}); }
  all(tag) { return [...(this.tag === tag ? [this] : []), ...this.children.flatMap(child => child.all(tag))]; }
}
class Range extends Element {  // as a browser does, it keeps its value within its ends and on one of its places
  set value(x) {
    const low = Number(this.min), high = Number(this.max), step = Number(this.step);
    const inside = Math.min(Math.max(Number(x), low), high);
    this.kept = String(Math.min(low + Math.round((inside - low) / step) * step, high));
  }
  get value() { return this.kept; }
}
const made = {};
globalThis.document = {
  body: new Element("body"),
  documentElement: new Element("html"),
  getElementById: id => made[id] ??= new Element(id),
  createElement: tag => tag === "input" ? new Range(tag) : new Element(tag),
};
globalThis.Option = class extends Element {
  constructor(words, value) { super("option"); Object.assign(this, {textContent: words, value}); }
};
globalThis.location = {search: process.argv[4] || ""};
globalThis.devicePixelRatio = 1;
globalThis.addEventListener = () => undefined;
globalThis.frameElement = null;
globalThis.matchMedia = () => ({addEventListener: () => undefined, matches: false});
globalThis.requestAnimationFrame = () => undefined;
globalThis.getComputedStyle = () => ({getPropertyValue: () => ""});
(0, eval)(script);

const {sliders, top} = made;
for (const action of actions) {
  if ("law" in action) {
    const choice = top.all("select")[0];
    choice.value = action.law;
    choice.listeners.change();
  }
  if ("move" in action) {
    const input = sliders.all("input").find(x => x.name === action.move);
    input.value = action.to;
    input.listeners.input();
  }
  if ("reset" in action) top.all("button").find(button => button.textContent === "Reset").listeners.click();
  const shown = sliders.all("label").filter(label => label.all("input").length).map(label => [label.all("input")[0].name, label.all("span")[0].textContent]);
  const places = sliders.all("input").map(input => [input.name, Number(input.value)]);
  const menu = top.all("label").filter(label => label.htmlFor === "law").map(label => label.textContent);
  const laws = top.all("option").map(option => option.value);
  const words = Object.fromEntries(sliders.all("label").map(label => [label.all("input")[0].name, label.words]));
  console.log(JSON.stringify({...JSON.parse(document.body.dataset.run), shown: Object.fromEntries(shown),
    places: Object.fromEntries(places), laws, menu, words, message: top.all("p")[0].textContent, unused: made.unused.hidden ? "" : made.unused.textContent}));
}
