"""Findings from the tables of RESULTS.md, with their figures."""

from __future__ import annotations

FINDINGS = (
    "**Convolution gains nothing on known objects.** F1 in `cv`: `svm` {svm/cv}, `cnn1` {cnn1/cv}, "
    "`mlp` {mlp/cv}, `rf` {rf/cv}. Less `cnn1` on the same splits: `svm` {svm/cv/difference}, "
    "`mlp` {mlp/cv/difference}, `rf` {rf/cv/difference}, each within two standard errors of zero. "
    "The paper's CNN1, {cnn1/cv/paper}, is reproduced. Its SVM, {svm/cv/paper}, is 6 points below "
    "ours.",
    "**Layout and depth hardly matter.** F1 of `cnn0` by layout: D1 {cnn0-d1-least-contact/cv}, D2 "
    "{cnn0-d2a-least-contact/cv} or {cnn0-d2b-least-contact/cv}, D3 {cnn0-d3-least-contact/cv}. "
    "In the paper D1 is 1.3 points ahead. Less `cnn1`: `cnn2` {cnn2/cv/difference}, `cnn3` "
    "{cnn3/cv/difference}. In the paper it is -2.2 and -2.0.",
    "**Augmentation gains nothing.** F1 in `unknown`: `cnn1-augmented` {cnn1-augmented/unknown}, "
    "`cnn1` {cnn1/unknown}, on the same seed {cnn1-augmented/unknown/difference}. The paper gains "
    "2.4. One training does not exclude a point more or less.",
    "**Each electrode by its own mean and spread gains a point.** Less `cnn1`: "
    "`blend-electrodes` {blend-electrodes/cv/difference} in `cv`, `small-electrodes` "
    "{small-electrodes/objects/difference} in `objects`, each about two standard errors.",
    "**Other objects cost every system 4 to 9 points.** F1 in `objects`: `svm` {svm/objects}, "
    "`cnn1` {cnn1/objects}, `rf` {rf/objects}, `svm-session` {svm-session/objects}, "
    "`small-session` {small-session/objects}.",
    "**On another day only session models hold.** F1 in `session`: `svm` {svm/session}, `rf` "
    "{rf/session}, `cnn1` {cnn1/session}; in `days` `svm` {svm/days}, `rf` {rf/days}. They still "
    "rank (AUC {svm/session/auc}, {rf/session/auc}, {cnn1/session/auc}), but at another threshold. "
    "After 50 unlabelled grasps `small-session` has {small-session/session}, `svm-session` "
    "{svm-session/session}, {svm-session/session/difference} to `cnn1`. In `days`, from nothing, "
    "`small-session` has {small-session/days}.",
)
"""Sentences on the tables. A figure is `SYSTEM/PROTOCOL`, F1, or the part of it that comes after; a
finding without all of its figures is left out. Read the words again when the figures change."""
HOW_SURE = (
    "How sure: one hand, 41 objects, three tables. Folds share grasps, and the standard errors of "
    "section 5 are corrected for that. A row of one seed does not show what another seed changes."
)
