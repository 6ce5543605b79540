use super::*;

const NONE: Variation = Variation {
    crop: None,
    flip_x: false,
    flip_y: false,
    transpose: false,
    rgb: [0, 1, 2],
    exposure: 1.0,
    axes: [0, 1, 2],
    mirrored: [false; 3],
    noise: None,
};
const TURNS: Augment = Augment {
    flip: true,
    transpose: true,
    rgb: false,
    exposure: false,
    axes: false,
    crop: false,
    noise: false,
};

fn turned(orientation: Variation) -> Vec<f32> {
    let mut planes = vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0];
    orientation.turn(&mut planes, 3);
    planes
}

#[test]
fn each_part_moves_pixels_as_its_name_says() {
    assert_eq!(turned(NONE), [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]);
    assert_eq!(
        turned(Variation {
            flip_x: true,
            ..NONE
        }),
        [3.0, 2.0, 1.0, 6.0, 5.0, 4.0, 9.0, 8.0, 7.0]
    );
    assert_eq!(
        turned(Variation {
            flip_y: true,
            ..NONE
        }),
        [7.0, 8.0, 9.0, 4.0, 5.0, 6.0, 1.0, 2.0, 3.0]
    );
    assert_eq!(
        turned(Variation {
            transpose: true,
            ..NONE
        }),
        [1.0, 4.0, 7.0, 2.0, 5.0, 8.0, 3.0, 6.0, 9.0]
    );
}

#[test]
fn off_never_turns_and_on_reaches_all_eight_orientations() {
    let drawn = |augment: Augment| (0..200).map(move |position| augment.draw(1, 2, position));
    assert!(drawn(Augment::default()).all(|orientation| orientation == NONE));
    let mut images: Vec<Vec<f32>> = drawn(TURNS).map(turned).collect();
    images.sort_by(|a, b| a.partial_cmp(b).expect("finite"));
    images.dedup();
    assert_eq!(images.len(), 8);
    assert!(
        drawn(Augment {
            flip: false,
            ..TURNS
        })
        .all(|v| !v.flip_x && !v.flip_y && v.rgb == NONE.rgb && v.exposure == 1.0)
    );
}

#[test]
fn every_order_of_rgb_and_the_whole_range_of_exposures_are_drawn() {
    let all = Augment::ALL;
    let drawn: Vec<Variation> = (0..300).map(|position| all.draw(1, 2, position)).collect();
    for order in ORDERS {
        let count = drawn.iter().filter(|v| v.rgb == order).count();
        // 50 expected, standard deviation 6.5.
        assert!((20..80).contains(&count), "{order:?}: {count}");
    }
    let exposures = drawn.iter().map(|v| v.exposure);
    let (least, most) = exposures.fold((f32::MAX, 0.0), |(a, b): (f32, f32), e| {
        (a.min(e), b.max(e))
    });
    assert!((0.5..0.55).contains(&least) && (1.8..2.0).contains(&most));
}

#[test]
fn every_axis_permutation_and_mirroring_is_drawn() {
    let axes = Augment {
        axes: true,
        ..Augment::default()
    };
    let drawn: Vec<_> = (0..2400)
        .map(|position| axes.draw(1, 2, position))
        .map(|v| (v.axes, v.mirrored))
        .collect();
    for order in ORDERS {
        for bits in 0..8 {
            let mirrored = [0, 1, 2].map(|axis| bits >> axis & 1 != 0);
            let count = drawn.iter().filter(|v| **v == (order, mirrored)).count();
            // 50 expected, standard deviation 7.
            assert!((20..85).contains(&count), "{order:?} {mirrored:?}: {count}");
        }
    }
}

/// A patch of 32 pixels in a scene of 36 x 34 has five possible rows and three possible
/// columns.
#[test]
fn crops_are_everywhere_in_the_scene_and_in_it() {
    let patch = Patch {
        scene: 0,
        y: 4,
        x: 2,
    };
    let crop = Augment {
        crop: true,
        ..Augment::default()
    };
    let mut counts = [[0; 3]; 5];
    for position in 0..1500 {
        let placed = crop.draw(1, 0, position).place(patch, (36, 34), 32);
        counts[placed.y as usize][placed.x as usize] += 1;
    }
    // 100 expected each, standard deviation 10.
    let all = counts.iter().flatten();
    assert!(all.clone().all(|n| (60..140).contains(n)), "{counts:?}");
    assert_eq!(NONE.place(patch, (36, 34), 32), patch);
}

/// Enabling other augmentations does not change the draws of one augmentation.
#[test]
fn augmentations_are_independent_of_each_other() {
    let all = Augment::ALL;
    for position in 0..50 {
        let (both, turns) = (all.draw(7, 0, position), TURNS.draw(7, 0, position));
        assert_eq!(turned(both), turned(turns));
    }
}

#[test]
fn augment_lists_survive_toml_and_errors_name_the_choices() {
    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct DataTable {
        augment: Augment,
    }
    let none = Augment::default();
    for (text, expected) in [
        ("augment = []", none),
        ("augment = [\"flip\"]", Augment { flip: true, ..none }),
        ("augment = [\"transpose\", \"flip\"]", TURNS),
        ("augment = [\"rgb\"]", Augment { rgb: true, ..none }),
        (
            "augment = [\"exposure\", \"rgb\"]",
            Augment {
                rgb: true,
                exposure: true,
                ..none
            },
        ),
        (
            "augment = [\"noise\", \"crop\"]",
            Augment {
                crop: true,
                noise: true,
                ..none
            },
        ),
        (
            "augment = [\"flip\", \"transpose\", \"rgb\", \"exposure\", \"axes\", \"crop\", \"noise\"]",
            Augment::ALL,
        ),
    ] {
        let table: DataTable = toml::from_str(text).expect(text);
        assert_eq!(table.augment, expected, "{text}");
        let written = toml::to_string(&table).expect("plain data");
        assert_eq!(
            toml::from_str::<DataTable>(&written).expect("its own"),
            table
        );
    }
    for text in [
        "augment = true",
        "augment = false",
        "augment = [\"rotate\"]",
    ] {
        let error = toml::from_str::<DataTable>(text).expect_err("not a list of names");
        assert_eq!(
            error.message(),
            "augment must be a list such as [\"flip\", \"transpose\"]; its names are \"flip\", \
             \"transpose\", \"rgb\", \"exposure\", \"axes\", \"crop\" and \"noise\""
        );
    }
}
