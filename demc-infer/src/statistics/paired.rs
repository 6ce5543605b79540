//! Paired differences as a table of seeds and base scenes.

use std::collections::BTreeMap;

/// Paired differences: one row per seed, one column per base scene. A cell is the mean over the
/// images of the base scene, so that each base scene counts once.
pub(super) struct PairedDifferences {
    /// `cells[seed][base]`.
    pub cells: Vec<Vec<f64>>,
    /// The base scenes, sorted.
    pub bases: Vec<String>,
    /// Mean of all cells.
    pub mean: f64,
    /// Mean of each seed minus `mean`.
    pub of_seeds: Vec<f64>,
    /// Mean of each base scene minus `mean`.
    pub of_bases: Vec<f64>,
}

impl PairedDifferences {
    /// The table of `differences[seed][image]`; `bases` has the base scene of each image. `None`
    /// without a cell.
    ///
    /// # Panics
    /// If a row and `bases` differ in length.
    pub fn new(differences: &[Vec<f64>], bases: &[&str]) -> Option<Self> {
        let mut images: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
        for (image, base) in bases.iter().enumerate() {
            images.entry(base).or_default().push(image);
        }
        if differences.is_empty() || images.is_empty() {
            return None;
        }
        let cells = differences.iter().map(|row| -> Vec<f64> {
            assert_eq!(row.len(), bases.len(), "a base scene for each image");
            let columns = images.values();
            columns
                .map(|images| mean(images.iter().map(|image| row[*image])))
                .collect()
        });
        let cells: Vec<Vec<f64>> = cells.collect();
        let total = mean(cells.iter().flatten().copied());
        let of_seeds = cells.iter().map(|row| mean(row.iter().copied()) - total);
        let of_bases =
            (0..images.len()).map(|base| mean(cells.iter().map(|row| row[base])) - total);
        Some(Self {
            mean: total,
            of_seeds: of_seeds.collect(),
            of_bases: of_bases.collect(),
            bases: images.keys().map(|base| (*base).to_owned()).collect(),
            cells,
        })
    }

    /// Variance of the mean of the seeds, and of the mean of the base scenes. A single seed or base
    /// scene has none.
    pub fn variances(&self) -> [f64; 2] {
        [&self.of_seeds, &self.of_bases].map(|effects| {
            let count = effects.len() as f64;
            let squares: f64 = effects.iter().map(|effect| effect * effect).sum();
            if effects.len() < 2 {
                0.0
            } else {
                squares / (count - 1.0) / count
            }
        })
    }

    /// The mean without the base scene of number `base`.
    pub fn without(&self, base: usize) -> f64 {
        self.mean - self.of_bases[base] / (self.bases.len() as f64 - 1.0)
    }
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (count, sum) = values.fold((0.0, 0.0), |(n, sum), value| (n + 1.0, sum + value));
    sum / count
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Base scene `b` has two images: (1 + 3) / 2 and (3 + 5) / 2. The mean of the cells is 2.5.
    #[test]
    fn each_base_scene_counts_once() {
        let rows = [vec![1.0, 1.0, 3.0], vec![3.0, 3.0, 5.0]];
        let table = PairedDifferences::new(&rows, &["b", "a", "b"]).expect("cells");
        assert_eq!(table.bases, ["a", "b"]);
        assert_eq!(table.cells, [[1.0, 2.0], [3.0, 4.0]]);
        assert_eq!(table.mean, 2.5);
        assert_eq!(table.of_seeds, [-1.0, 1.0]);
        assert_eq!(table.of_bases, [-0.5, 0.5]);
        assert_eq!(table.variances(), [1.0, 0.25]);
        assert_eq!([table.without(0), table.without(1)], [3.0, 2.0]);
    }

    #[test]
    fn a_table_without_cells_is_none() {
        assert!(PairedDifferences::new(&[], &["a"]).is_none());
        assert!(PairedDifferences::new(&[vec![]], &[]).is_none());
    }
}
