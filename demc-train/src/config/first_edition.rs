//! Keys of the first edition of the configuration, which are refused with their replacement.

/// Keys of the first edition, and what replaces each.
pub(super) const REPLACEMENTS: [(&str, &str); 16] = [
    (
        "train.loss",
        "write weights in [loss]: relmse, dssim, smape, l1",
    ),
    ("train.loss_epsilon", "write loss.relmse_epsilon"),
    ("train.ssim", "write loss.dssim"),
    ("train.smape", "write loss.smape"),
    (
        "train.muon",
        "write optimizer.kind = \"muon\" and optimizer.muon_max_rows",
    ),
    ("train.lr_start", "write optimizer.lr_start"),
    ("train.lr_end", "write optimizer.lr_end"),
    ("train.decay", "write optimizer.lr_decay"),
    ("train.warmup", "write optimizer.warmup_steps"),
    ("train.adam_epsilon", "write optimizer.adam_epsilon"),
    (
        "train.grad_clip",
        "write optimizer.max_grad_norm (absent: no clipping)",
    ),
    ("train.ema", "write train.ema_decay (absent: no average)"),
    (
        "data.demodulate",
        "write data.albedo_demodulation_epsilon (absent: off)",
    ),
    ("train.lr_fan_in", "delete it, it was removed"),
    ("train.recycle", "delete it, it was removed"),
    (
        "data.reference_filter",
        "delete it; python/tools/references.py filters references",
    ),
];

/// The key that was a switch in the first edition and is a list now.
const AUGMENT: &str = "data.augment";

/// Why this key, or its boolean value, is one of the first edition; `None` if it is not.
pub(super) fn refusal(key: &str, is_boolean: bool) -> Option<String> {
    let known = REPLACEMENTS.iter().find(|(old, _)| *old == key);
    let text = known.map(|(key, advice)| format!("first-edition key `{key}`: {advice}"));
    let switch = (key == AUGMENT && is_boolean).then(|| {
        format!(
            "first-edition value of `{key}`: write a list, such as [\"flip\", \"transpose\"] or []"
        )
    });
    text.or(switch)
}
