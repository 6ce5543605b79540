//! Warnings about suspicious signs in a run, each once per run, resumed or not:
//!
//! - a loss that stalls or rises;
//! - a scene that dominates the loss;
//! - dead channels of the detail map, and dormant channels;
//! - an all-zero output.
//!
//! Every threshold is ours.

use serde::{Deserialize, Serialize};

use crate::run::validation::NetworkHealth;

/// Number of windows in a run; the loss is averaged over each.
const WINDOWS: u64 = 50;
/// Fewest and most steps of a window.
const WINDOW_STEPS: (u64, u64) = (100, 2000);
/// Windows before a stalled loss is reported.
const PATIENCE: u64 = 4;
/// A loss falls if a window's mean is below this share of the first one's.
const FALLEN: f64 = 0.95;
/// A loss rises if a window's mean is at least this multiple of the smallest one.
const RISEN: f64 = 2.0;
/// A scene dominates the loss if it contributes this share of it.
const DOMINANT: f64 = 0.5;
/// With fewer scenes, one of them dominates by chance.
const MIN_SCENES: usize = 4;
/// Share of zeros in the output, where the reference is not black, from which the output counts as
/// zero.
const ZERO_OUTPUT: f64 = 0.25;
/// Share of dormant channels that is reported. A quarter is common in the first hundreds of steps
/// and recovers.
const DORMANT: f64 = 0.3;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum WarningTopic {
    NotFalling,
    ZeroLoss,
    Climbing,
    OneScene,
    DeadChannels,
    PinnedOutput,
    Dormant,
}

/// The state of the warnings of a run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WarningState {
    /// Steps and sum of the losses of the current window.
    window: (u64, f64),
    windows: u64,
    first: f64,
    best: f64,
    /// Sum of the losses of each scene in the current epoch.
    scenes: Vec<f64>,
    /// Patches in the current epoch.
    patches: u64,
    passes: u64,
    said: Vec<WarningTopic>,
}

/// What the warnings need to know about a run.
#[derive(Clone, Copy, Debug)]
pub struct WarningContext<'a> {
    /// Steps of the run.
    pub steps: u64,
    /// Patches per epoch.
    pub patches: u64,
    /// Names of the training scenes.
    pub scenes: &'a [String],
}

impl WarningState {
    /// Adds the loss of a step, and of each of its patches by scene. Returns warnings.
    pub fn step(
        &mut self,
        facts: WarningContext,
        loss: f64,
        patches: impl Iterator<Item = (usize, f64)>,
    ) -> Vec<String> {
        let mut warnings = Vec::new();
        warnings.extend(self.trend(facts.steps, loss));
        self.scenes.resize(facts.scenes.len(), 0.0);
        for (scene, loss) in patches {
            self.scenes[scene] += loss;
            self.patches += 1;
        }
        if self.patches >= facts.patches {
            // In the first epoch the loss falls so fast that its first scenes dominate.
            if self.passes > 0 {
                warnings.extend(self.dominance(facts.scenes));
            }
            self.scenes.fill(0.0);
            (self.patches, self.passes) = (0, self.passes + 1);
        }
        warnings
    }

    fn trend(&mut self, steps: u64, loss: f64) -> Option<String> {
        let length = (steps / WINDOWS).clamp(WINDOW_STEPS.0, WINDOW_STEPS.1);
        let (count, sum) = &mut self.window;
        *count += 1;
        *sum += loss;
        if *count < length {
            return None;
        }
        let mean = *sum / *count as f64;
        self.window = (0, 0.0);
        self.windows += 1;
        if self.windows == 1 {
            (self.first, self.best) = (mean, mean);
        }
        self.best = self.best.min(mean);
        let (first, best) = (self.first, self.best);
        if mean == 0.0 {
            return self.once(WarningTopic::ZeroLoss, || {
                format!(
                    "the loss is 0 over the last {length} steps, so nothing is learned; are the references black? \
                     `demc-data doctor` inspects them"
                )
            });
        }
        if best > 0.0 && mean >= RISEN * best {
            return self.once(WarningTopic::Climbing, || {
                format!(
                    "the loss rises: mean {} over the last {length} steps, {} over the best {length}; \
                     a smaller optimizer.lr_start or optimizer.max_grad_norm = 1.0 usually helps",
                    shown(mean),
                    shown(best)
                )
            });
        }
        if self.windows >= PATIENCE && best >= FALLEN * first {
            return self.once(WarningTopic::NotFalling, || {
                format!(
                    "the loss stalls: mean {} over the last {length} steps, {} over the first {length}; \
                     `demc-train find-lr` finds a learning rate",
                    shown(mean),
                    shown(first)
                )
            });
        }
        None
    }

    fn dominance(&mut self, names: &[String]) -> Option<String> {
        let sum: f64 = self.scenes.iter().sum();
        let (scene, most) = self
            .scenes
            .iter()
            .copied()
            .enumerate()
            .max_by(|a, b| a.1.total_cmp(&b.1))?;
        if names.len() < MIN_SCENES || sum <= 0.0 || most < DOMINANT * sum {
            return None;
        }
        let (name, share) = (&names[scene], 100.0 * most / sum);
        self.once(WarningTopic::OneScene, || {
            format!(
                "one scene dominates the loss: {name} contributes {share:.0} %, so the network hardly learns from \
                 the others; inspect it with `demc-data inspect`, or try optimizer.max_grad_norm = 1.0 or a larger \
                 loss.relmse_epsilon"
            )
        })
    }

    /// Adds the result of a validation. Returns warnings.
    pub fn validation(&mut self, health: &NetworkHealth) -> Vec<String> {
        let mut warnings = Vec::new();
        let dead = health.dead_channels.unwrap_or(0);
        if dead > 0 {
            warnings.extend(self.once(WarningTopic::DeadChannels, || {
                format!(
                    "{dead} of the detail map's 3 channels are zero almost everywhere, so the encoder receives less \
                     of the features; a dead channel rarely recovers; optimizer.warmup_steps usually helps"
                )
            }));
        }
        let share = health.zero_share;
        if share >= ZERO_OUTPUT {
            warnings.extend(self.once(WarningTopic::PinnedOutput, || {
                format!(
                    "the output is zero: {:.0} % of its values where the reference is not black; ReLU and x^gamma \
                     have no gradient there; restart with model.head = \"grey\" or a smaller optimizer.lr_start",
                    100.0 * share
                )
            }));
        }
        warnings
    }

    /// Adds the share of dormant channels. Returns a warning.
    pub fn dormant(&mut self, share: f64) -> Option<String> {
        if share < DORMANT {
            return None;
        }
        self.once(WarningTopic::Dormant, || {
            format!(
                "{:.0} % of the network's channels are dormant: zero everywhere, without a gradient for 175 steps; \
                 optimizer.kind = \"muon\", optimizer.weight_decay or a smaller optimizer.lr_start keeps more of them active",
                100.0 * share
            )
        })
    }

    fn once(&mut self, topic: WarningTopic, text: impl FnOnce() -> String) -> Option<String> {
        if self.said.contains(&topic) {
            return None;
        }
        self.said.push(topic);
        Some(text())
    }
}

/// A loss with four decimals; a smaller one with its exponent.
fn shown(loss: f64) -> String {
    if loss != 0.0 && loss.abs() < 0.001 {
        format!("{loss:.2e}")
    } else {
        format!("{loss:.4}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(count: usize) -> Vec<String> {
        (0..count).map(|i| format!("scene-{i}")).collect()
    }

    fn run(losses: impl Iterator<Item = f64>, scenes: usize) -> Vec<String> {
        let names = names(scenes);
        let facts = WarningContext {
            steps: 5000,
            patches: 100,
            scenes: &names,
        };
        let mut watch = WarningState::default();
        losses
            .enumerate()
            .flat_map(|(i, loss)| watch.step(facts, loss, [(i % scenes, loss)].into_iter()))
            .collect()
    }

    #[test]
    fn many_dormant_channels_are_reported_once() {
        let mut watch = WarningState::default();
        assert_eq!(watch.dormant(0.1), None);
        let said = watch.dormant(0.42).unwrap();
        assert!(said.starts_with("42 % of the network's channels are dormant"));
        assert_eq!(watch.dormant(0.5), None);
    }

    #[test]
    fn a_falling_loss_gives_no_warning() {
        let falling = (0..2000).map(|i| 1.0 / (1.0 + f64::from(i) / 500.0));
        assert_eq!(run(falling, 10), Vec::<String>::new());
    }

    #[test]
    fn a_stalled_loss_is_reported_once_after_four_windows() {
        assert_eq!(run((0..399).map(|_| 1.0), 10).len(), 0);
        let said = run((0..2000).map(|_| 1.0), 10);
        assert_eq!(said.len(), 1, "{said:?}");
        assert!(said[0].starts_with("the loss stalls: mean 1.0000"));
    }

    #[test]
    fn a_rising_loss_is_reported() {
        let losses = (0..1000).map(|i| {
            if i < 600 {
                1.0 - f64::from(i) / 1000.0
            } else {
                2.0
            }
        });
        let said = run(losses, 10);
        assert_eq!(said.len(), 1, "{said:?}");
        assert!(said[0].starts_with("the loss rises: mean 2.0000"));
    }

    #[test]
    fn a_zero_loss_is_reported_once_and_has_no_dominant_scene() {
        let said = run((0..2000).map(|_| 0.0), 10);
        assert_eq!(said.len(), 1, "{said:?}");
        assert!(said[0].starts_with("the loss is 0 over the last 100 steps"));
        let said = run((0..1000).map(|i| if i < 600 { 1e-6 } else { 1.0 }), 10);
        let rises = |line: &String| line.contains("1.00e-6 over the best 100");
        assert!(said.iter().any(rises), "{said:?}");
    }

    #[test]
    fn a_dominant_scene_is_reported() {
        // Not in the first epoch.
        let losses =
            |dominant: f64| (0..200).map(move |i| if i % 10 == 3 { dominant } else { 1.0 });
        assert_eq!(run(losses(8.0), 10), Vec::<String>::new());
        assert_eq!(run(losses(12.0).take(100), 10), Vec::<String>::new());
        let said = run(losses(12.0), 10);
        assert!(said[0].contains("scene-3 contributes 57 %"), "{said:?}");
        // With two scenes one always dominates.
        assert_eq!(run((0..200).map(|i| f64::from(i % 2) + 0.1), 2).len(), 0);
    }

    #[test]
    fn dead_channels_and_a_zero_output_are_reported_once() {
        let mut watch = WarningState::default();
        let health = |dead_channels, zero_share| NetworkHealth {
            dead_channels,
            zero_share,
        };
        assert_eq!(watch.validation(&health(None, 0.1)).len(), 0);
        assert_eq!(watch.validation(&health(Some(0), 0.0)).len(), 0);
        let said = watch.validation(&health(Some(2), 0.5));
        assert!(said[0].starts_with("2 of the detail map's 3") && said[1].contains("50 %"));
        assert_eq!(watch.validation(&health(Some(2), 0.5)).len(), 0);
    }

    #[test]
    fn the_state_survives_a_checkpoint() {
        let mut watch = WarningState::default();
        let names = names(3);
        let facts = WarningContext {
            steps: 10,
            patches: 9,
            scenes: &names,
        };
        watch.step(facts, 0.1 + 0.2, [(2, 0.7)].into_iter());
        let text = serde_json::to_string(&watch).unwrap();
        assert_eq!(serde_json::from_str::<WarningState>(&text).unwrap(), watch);
    }
}
