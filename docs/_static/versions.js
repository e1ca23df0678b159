// The menu of versions: `switcher.json` beside the folders of the versions lists them.
// A page that another version does not have leads to its front page.
async function listVersions(label) {
  const menu = label.querySelector("select"), {root, page, version} = menu.dataset;
  const above = new URL((root || "./") + "../", location.href);
  const versions = await (await fetch(new URL("switcher.json", above))).json();
  for (const each of versions) {
    const isShown = each.version === version;
    menu.append(new Option(each.name, each.url, isShown, isShown));
  }
  menu.addEventListener("change", async () => {
    const other = new URL(menu.value, above), same = new URL(page, other);
    const found = await fetch(same, {method: "HEAD"});
    location.href = found.ok ? same : other;
  });
  label.hidden = false;
}
// Pages that are opened as files cannot read others.
if (location.protocol !== "file:") document.querySelectorAll("label.versions").forEach(listVersions);
