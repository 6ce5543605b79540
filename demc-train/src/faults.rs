//! The patches of a step in words: what an error or a warning of a loss that is not finite names.

use demc_data::Scene;

use crate::trainer::Step;

/// Patches that are named.
const MOST_NAMED: usize = 8;

/// Scene, origin and loss of a step's patches; those that are not finite alone, where there are such.
pub fn patches_of(step: &Step, scenes: &[Scene]) -> String {
    let bad = |loss: f64| !loss.is_finite();
    let any = step.patches.iter().any(|(_, loss)| bad(*loss));
    let named = step.patches.iter().filter(|(_, loss)| !any || bad(*loss));
    let mut texts: Vec<String> = named
        .map(|(patch, loss)| {
            let scene = &scenes[patch.scene as usize].name;
            format!("{scene} (x {}, y {}): {loss:.4}", patch.x, patch.y)
        })
        .collect();
    if texts.len() > MOST_NAMED {
        let more = texts.len() - MOST_NAMED;
        texts.truncate(MOST_NAMED);
        texts.push(format!("{more} more"));
    }
    texts.join(", ")
}
