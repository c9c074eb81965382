"use strict";
// Tables: a click on a column's name sorts by it, a second click the other way round.
for (const table of document.querySelectorAll("table")) {
  const body = table.tBodies[0];
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    head.dataset.sort = "";
    head.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") === "ascending";
      const key = (row) => row.cells[column].textContent.replace("−", "-").replace(/\s*%$/, "");
      const number = (text) => (text === "exact" ? Infinity : text === "–" ? NaN : Number(text.replace(/ dB$/, "")));
      const compare = (a, b) => {
        const [x, y] = [key(a), key(b)];
        const [u, v] = [number(x), number(y)];
        if (x !== "" && y !== "" && !Number.isNaN(u) && !Number.isNaN(v)) return u === v ? 0 : u - v;
        return x.localeCompare(y);
      };
      const rows = [...body.rows].sort(compare);
      if (down) rows.reverse();
      for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      body.append(...rows);
    });
  });
}
// Tensors: one at a time instead of a list.
const list = document.getElementById("tensor-list");
if (list) {
  const cards = [...list.querySelectorAll("details.tensor")];
  const select = document.createElement("select");
  for (const card of cards) select.append(new Option(card.firstElementChild.textContent));
  const show = () => cards.forEach((card, index) => {
    card.hidden = index !== select.selectedIndex;
    card.open = !card.hidden;
  });
  select.addEventListener("change", show);
  const label = document.createElement("label");
  label.className = "picker";
  label.append("Tensor: ", select);
  list.before(label);
  list.classList.add("picked");
  show();
}
// Attention: one query at a time, the same in both drawings of a frame.
for (const article of document.querySelectorAll(".looks")) {
  const groups = [...article.querySelectorAll(".query-keys")];
  const picks = [...article.querySelectorAll(".pick")];
  const select = document.createElement("select");
  const names = new Map(picks.map((pick) => [pick.dataset.query, pick.firstElementChild.textContent]));
  for (const [query, name] of names) select.append(new Option(name, query));
  select.value = groups.find((group) => group.classList.contains("shown")).dataset.query;
  const show = (query) => {
    select.value = query;
    for (const group of groups) group.classList.toggle("shown", group.dataset.query === query);
  };
  select.addEventListener("change", () => show(select.value));
  for (const pick of picks) pick.addEventListener("click", () => show(pick.dataset.query));
  const label = document.createElement("label");
  label.className = "picker";
  label.append("Query: ", select);
  article.querySelector(".columns").before(label);
}
