// What a word means comes before where it is used; the rest as Sphinx has it.
var Scorer = {
  score: ([page, , , , score]) => (page === "glossary" ? score + 100 : score),
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};
