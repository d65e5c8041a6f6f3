// Search: guide pages first, then the reference. An object whose name is no plain word comes first if the query is it.
var Scorer = {
  objNameMatch: 30, objPartialMatch: 0, objPrio: { 0: 0, 1: 0, 2: 0 }, objPrioDefault: 0,
  title: 15, partialTitle: 7, term: 5, partialTerm: 2,
  score: ([page, title, , , score, , kind]) =>
    page.startsWith("reference/") && !(kind === "object" && /[A-Z_]/.test(title.split(".").pop())) ? score - 50 : score,
};
