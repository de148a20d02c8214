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
"""Sentences on the tables. A placeholder is `SYSTEM/PROTOCOL`, its F1, or a part named after it. A
finding that lacks a figure is left out. Check the sentences when the figures change."""
HOW_SURE = (
    "How sure: one hand, 41 objects, three tables. Folds share grasps, and the standard errors of "
    "section 5 are corrected for that. A row of one seed does not show what another seed changes. "
    "Limits, augmentation and the default were chosen on these same tables, so their figures may "
    "be a little too good. On a day that no choice has seen the order is the same (section 8): F1 "
    "82 for the default, from nothing, and 65 for `cnn1` as published."
)
SEALED = (
    "The test files of the data set's second version, `bts3v2_*_test.csv`, have 1,149 grasps of 10 "
    "new objects on a third day. No training, choice or test of this project has seen them, and "
    "its authors have not looked at them. The shipped models were scored once, three sessions from "
    "nothing. In %, grasps as recorded / in random order:",
    (
        "model",
        "F1 of judged, nothing told",
        "slips among stable",
        "F1, every judged lift told",
        "at `max_slip_when_stable` 0.05: slips / good lifts kept",
        "judged",
    ),
    (
        ("`small-session`", "82.1 / 81.8", "19.4 / 19.9", "94.6 / 92.9", "3.6 / 66, 2.3 / 61",
         "95 / 97"),
        ("`cnn1-session`", "79.7 / 78.0", "24.4 / 24.9", "94.6 / 92.4", "4.0 / 59, 2.1 / 58",
         "93 / 95"),
        ("`cnn1`, as published", "64.7 / 64.7", "36.6 / 36.6", "81.3 / 80.6", "7.5 / 17, 6.7 / 15",
         "31 / 31"),
    ),
    "    git clone https://github.com/3dperceptionlab/biotacsp-stability-set-v2\n"
    "    graspd replay FILE --model MODEL [--outcomes [--max-slip-when-stable 0.05]]",
)  # fmt: skip
"""Section on the sealed test day: text, titles, rows, commands."""
