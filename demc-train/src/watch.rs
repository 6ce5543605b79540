//! Warnings where users lose days: a loss that does not fall or climbs, a scene that owns it, a detail map with dead
//! channels, an output pinned at zero.
//!
//! Each is said once a run; a resumed run remembers. Every threshold is ours.

use serde::{Deserialize, Serialize};

use crate::validation::Health;

/// Windows of the run over which losses are averaged.
const WINDOWS: u64 = 50;
/// Fewest and most steps of a window: the loss of a single step says little.
const WINDOW_STEPS: (u64, u64) = (100, 2000);
/// Windows before a loss that does not fall is one.
const PATIENCE: u64 = 4;
/// A loss has fallen where a window's mean is below this share of the first one's.
const FALLEN: f64 = 0.95;
/// A loss climbs where a window's mean is this many times the best one's.
const CLIMBED: f64 = 2.0;
/// A scene owns the loss where it brings this share of it, of at least `FEWEST_SCENES`.
const OWNED: f64 = 0.5;
/// With fewer scenes one of them may well bring most.
const FEWEST_SCENES: usize = 4;
/// Share of the outputs that are zero where the reference is not, from which the output counts as pinned.
const PINNED: f64 = 0.25;
/// Share of the network's channels that are dormant, from which a network is not the one that was asked for. A quarter is common in a
/// run's first hundreds of steps, and comes back.
const DORMANT: f64 = 0.3;

/// What a warning is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
enum Topic {
    NotFalling,
    Climbing,
    OneScene,
    DeadChannels,
    PinnedOutput,
    Dormant,
}

/// What a run has seen so far, as far as its warnings need it.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Watch {
    /// Steps and summed loss of the window under way.
    window: (u64, f64),
    /// Windows that are complete.
    windows: u64,
    /// Mean loss of the first.
    first: f64,
    /// Smallest mean of any.
    best: f64,
    /// Summed loss of each scene in the pass over the data under way.
    scenes: Vec<f64>,
    /// Patches in it.
    patches: u64,
    /// Passes that are complete.
    passes: u64,
    /// What was warned of already.
    said: Vec<Topic>,
}

/// What a watch knows about its run.
#[derive(Clone, Copy, Debug)]
pub struct Setting<'a> {
    /// Steps of the run.
    pub steps: u64,
    /// Patches of an epoch.
    pub patches: u64,
    /// Names of the training scenes.
    pub scenes: &'a [String],
}

impl Watch {
    /// Takes in a step's loss and the loss of each of its patches, by scene. Returns what the user should know.
    pub fn step(
        &mut self,
        setting: Setting,
        loss: f64,
        patches: impl Iterator<Item = (usize, f64)>,
    ) -> Vec<String> {
        let mut warnings = Vec::new();
        warnings.extend(self.trend(setting.steps, loss));
        self.scenes.resize(setting.scenes.len(), 0.0);
        for (scene, loss) in patches {
            self.scenes[scene] += loss;
            self.patches += 1;
        }
        if self.patches >= setting.patches {
            // In the first pass the loss falls so fast that the first scenes own it.
            if self.passes > 0 {
                warnings.extend(self.owner(setting.scenes));
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
        if mean >= CLIMBED * best {
            return self.once(Topic::Climbing, || {
                format!(
                    "the loss climbs: {mean:.4} over the last {length} steps, {best:.4} at its best; \
                     a smaller train.lr_start or train.grad_clip = 1.0 helps as a rule"
                )
            });
        }
        if self.windows >= PATIENCE && best >= FALLEN * first {
            return self.once(Topic::NotFalling, || {
                format!(
                    "the loss does not fall: {mean:.4} over the last {length} steps, {first:.4} over the first; \
                     `demc-train find-lr` finds a learning rate"
                )
            });
        }
        None
    }

    fn owner(&mut self, names: &[String]) -> Option<String> {
        let sum: f64 = self.scenes.iter().sum();
        let (scene, most) = self
            .scenes
            .iter()
            .copied()
            .enumerate()
            .max_by(|a, b| a.1.total_cmp(&b.1))?;
        if names.len() < FEWEST_SCENES || most < OWNED * sum {
            return None;
        }
        let (name, share) = (&names[scene], 100.0 * most / sum);
        self.once(Topic::OneScene, || {
            format!(
                "one scene owns the loss: {name} brings {share:.0} % of it; the others are hardly learned from. Look at it \
                 with `demc-data inspect`, and at what train.grad_clip = 1.0 or a \
                 larger train.loss_epsilon do"
            )
        })
    }

    /// Takes in what a validation saw.
    pub fn validation(&mut self, health: &Health) -> Vec<String> {
        let mut warnings = Vec::new();
        let dead = health.dead_channels.unwrap_or(0);
        if dead > 0 {
            warnings.extend(self.once(Topic::DeadChannels, || {
                format!(
                    "{dead} of the detail map's 3 channels are zero nearly everywhere: the encoder behind it sees that much \
                     less of the features, and a dead channel rarely comes back. train.warmup helps as a rule"
                )
            }));
        }
        let share = health.zero_share;
        if share >= PINNED {
            warnings.extend(self.once(Topic::PinnedOutput, || {
                format!(
                    "the output is pinned at zero: {:.0} % of its values, where the reference is not; there neither ReLU nor \
                     x^gamma has a gradient. Start again with model.head = \"grey\" or a smaller train.lr_start",
                    100.0 * share
                )
            }));
        }
        warnings
    }

    /// Takes in the share of the channels that are dormant.
    pub fn dormant(&mut self, share: f64) -> Option<String> {
        if share < DORMANT {
            return None;
        }
        self.once(Topic::Dormant, || {
            format!(
                "{:.0} % of the network's channels are dormant: zero everywhere, without a gradient for 175 steps. Wide layers go first, \
                 by steps that are too large for them: train.muon = 128 takes steps that keep more of them alive, train.lr_fan_in = 96 \
                 makes those of the others smaller, train.recycle = 1000 lets dormant channels begin anew",
                100.0 * share
            )
        })
    }

    fn once(&mut self, topic: Topic, text: impl FnOnce() -> String) -> Option<String> {
        if self.said.contains(&topic) {
            return None;
        }
        self.said.push(topic);
        Some(text())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(count: usize) -> Vec<String> {
        (0..count).map(|i| format!("scene-{i}")).collect()
    }

    /// What is said over a run of these losses, all of one scene among `scenes`, in turn.
    fn run(losses: impl Iterator<Item = f64>, scenes: usize) -> Vec<String> {
        let names = names(scenes);
        let setting = Setting {
            steps: 5000,
            patches: 100,
            scenes: &names,
        };
        let mut watch = Watch::default();
        losses
            .enumerate()
            .flat_map(|(i, loss)| watch.step(setting, loss, [(i % scenes, loss)].into_iter()))
            .collect()
    }

    #[test]
    fn many_dormant_channels_are_named_once() {
        let mut watch = Watch::default();
        assert_eq!(watch.dormant(0.1), None);
        let said = watch.dormant(0.42).unwrap();
        assert!(said.starts_with("42 % of the network's channels are dormant"));
        assert_eq!(watch.dormant(0.5), None);
    }

    #[test]
    fn a_loss_that_falls_is_no_news() {
        let falling = (0..2000).map(|i| 1.0 / (1.0 + f64::from(i) / 500.0));
        assert_eq!(run(falling, 10), Vec::<String>::new());
    }

    #[test]
    fn a_loss_that_stays_is_named_once_after_four_windows() {
        assert_eq!(run((0..399).map(|_| 1.0), 10).len(), 0);
        let said = run((0..2000).map(|_| 1.0), 10);
        assert_eq!(said.len(), 1, "{said:?}");
        assert!(said[0].starts_with("the loss does not fall: 1.0000"));
    }

    #[test]
    fn a_loss_that_climbs_after_it_fell_is_named() {
        let losses = (0..1000).map(|i| {
            if i < 600 {
                1.0 - f64::from(i) / 1000.0
            } else {
                2.0
            }
        });
        let said = run(losses, 10);
        assert_eq!(said.len(), 1, "{said:?}");
        assert!(said[0].starts_with("the loss climbs: 2.0000"));
    }

    #[test]
    fn a_scene_that_brings_most_of_the_loss_is_named() {
        // In the first pass nothing is said: its first losses own it.
        let losses = |owner: f64| (0..200).map(move |i| if i % 10 == 3 { owner } else { 1.0 });
        assert_eq!(run(losses(8.0), 10), Vec::<String>::new());
        assert_eq!(run(losses(12.0).take(100), 10), Vec::<String>::new());
        let said = run(losses(12.0), 10);
        assert!(said[0].contains("scene-3 brings 57 %"), "{said:?}");
        // Of two scenes one always does.
        assert_eq!(run((0..200).map(|i| f64::from(i % 2) + 0.1), 2).len(), 0);
    }

    #[test]
    fn dead_channels_and_a_pinned_output_are_named_once() {
        let mut watch = Watch::default();
        let health = |dead_channels, zero_share| Health {
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
    fn a_watch_survives_a_checkpoint() {
        let mut watch = Watch::default();
        let names = names(3);
        let setting = Setting {
            steps: 10,
            patches: 9,
            scenes: &names,
        };
        watch.step(setting, 0.1 + 0.2, [(2, 0.7)].into_iter());
        let text = serde_json::to_string(&watch).unwrap();
        assert_eq!(serde_json::from_str::<Watch>(&text).unwrap(), watch);
    }
}
