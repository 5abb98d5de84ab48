"use strict";
// The page is complete without this: links lead to sections. With it a number opens its origin in a drawer.

const root = document.documentElement;
const themes = ["auto", "light", "dark"];
const themeButton = document.getElementById("theme");

function setTheme(name) {
  if (name === "auto") delete root.dataset.theme;
  else root.dataset.theme = name;
  themeButton.textContent = "Theme: " + name;
}

themeButton.hidden = false;
themeButton.addEventListener("click", () => {
  const next = (themes.indexOf(root.dataset.theme || "auto") + 1) % themes.length;
  setTheme(themes[next]);
});

// A link into closed details opens them, so that what it leads to can be seen.
function reveal() {
  const target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (!target) return;
  for (let element = target; element; element = element.parentElement) {
    if (element.tagName === "DETAILS") element.open = true;
  }
  target.scrollIntoView();
}
addEventListener("hashchange", reveal);
addEventListener("load", reveal);

const drawer = document.getElementById("drawer");
const origin = document.getElementById("origin");

function show(section) {
  const copy = section.cloneNode(true);
  for (const element of [copy, ...copy.querySelectorAll("[id]")]) element.removeAttribute("id");
  origin.replaceChildren(copy);
  drawer.showModal();
  drawer.scrollTop = 0;
}

document.addEventListener("click", (event) => {
  const link = event.target.closest("a[href^='#']");
  if (!link || event.metaKey || event.ctrlKey || event.shiftKey) return;
  const name = link.getAttribute("href").slice(1);
  const target = document.getElementById(name);
  if (target && target.classList.contains("provenance")) {
    event.preventDefault();
    show(target);
  } else if (drawer.open) {
    drawer.close(); // to a run: the page behind the drawer goes there
  }
});

document.getElementById("close").addEventListener("click", () => drawer.close());
drawer.addEventListener("click", (event) => {
  if (event.target === drawer) drawer.close();
});

// Printed, everything that can be opened is open.
let closed = [];
addEventListener("beforeprint", () => {
  closed = [...document.querySelectorAll("details:not([open])")];
  for (const details of closed) details.open = true;
});
addEventListener("afterprint", () => {
  for (const details of closed) details.open = false;
});

// The contents follow the reader.
const links = new Map([...document.querySelectorAll("nav a")].map((link) => [link.hash.slice(1), link]));
const seen = new IntersectionObserver(
  (entries) => {
    for (const entry of entries) {
      if (!entry.isIntersecting) continue;
      for (const link of links.values()) link.removeAttribute("aria-current");
      links.get(entry.target.id)?.setAttribute("aria-current", "true");
    }
  },
  { rootMargin: "0px 0px -70% 0px" },
);
for (const section of document.querySelectorAll("main > section")) seen.observe(section);
