// How the search of the site orders what it found: pages and sections that are named after the
// question first, those for contributors and the changelog last.
var Scorer = {
  score: ([page, title, anchor, , score]) => {
    const asked = new URLSearchParams(window.location.search).get("q") || "";
    const words = asked.toLowerCase().split(/\s+/);
    const named = words.filter((word) => title.toLowerCase().includes(word)).length;
    const others = /CHANGELOG|CONTRIBUTING|contributors/.test(page) ? 200 : 0;
    return score + (100 * named) / words.length + (anchor ? 0 : 20) - others;
  },
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
