use super::*;
use crate::image::frame::FEATURES;

const SIDE: usize = 40;

/// A floor and a wall seen from `camera`, in world space, with grey albedo.
fn room(camera: Vector) -> Frame {
    let pixels = SIDE * SIDE;
    let mut features = vec![0.5; FEATURES * pixels];
    for y in 0..SIDE {
        for x in 0..SIDE {
            let [u, v] = [x, y].map(|value| value as f32 / SIDE as f32 - 0.49);
            // The ray hits the floor y = 0 or the wall z = 0, whichever is nearer.
            let ray = [u, -v, -1.0];
            let wall = camera[2];
            let floor = if ray[1] < 0.0 {
                -camera[1] / ray[1]
            } else {
                f32::INFINITY
            };
            let (distance, normal) = if floor < wall {
                (floor, [0.0, 1.0, 0.0])
            } else {
                (wall, [0.0, 0.0, 1.0])
            };
            for channel in 0..3 {
                let i = y * SIDE + x;
                features[(NORMAL + channel) * pixels + i] = normal[channel];
                features[(POSITIONS + channel) * pixels + i] =
                    camera[channel] + distance * ray[channel];
            }
        }
    }
    Frame {
        name: "room".into(),
        width: SIDE,
        height: SIDE,
        color: vec![0.5; 3 * pixels],
        features,
        reference: None,
        mask: Some(vec![1.0; pixels]),
        alpha: None,
        passes: None,
        clamped: 0,
    }
}

fn mapped(mut frame: Frame, first: usize, map: impl Fn(Vector) -> Vector) -> Frame {
    let pixels = SIDE * SIDE;
    for i in 0..pixels {
        let mapped = map(vector(&frame, first, i));
        for (channel, value) in mapped.into_iter().enumerate() {
            frame.features[(first + channel) * pixels + i] = value;
        }
    }
    frame
}

fn found(frame: &Frame) -> Vec<String> {
    let found = warnings(frame).into_iter();
    found.map(|warning| warning.to_string()).collect()
}

const CAMERA: Vector = [1.0, 1.5, 4.0];

#[test]
fn a_room_in_world_space_causes_no_warning() {
    assert_eq!(found(&room(CAMERA)), [""; 0]);
}

#[test]
fn each_mistake_has_its_own_words() {
    let one = |frame: &Frame| match &found(frame)[..] {
        [warning] => warning.clone(),
        others => panic!("one warning, not {others:?}"),
    };
    let packed = mapped(room(CAMERA), NORMAL, |n| n.map(|x| x / 2.0 + 0.5));
    assert!(one(&packed).contains("packed into 0 to 1"));
    let long = mapped(room(CAMERA), NORMAL, |n| n.map(|x| 2.0 * x));
    assert!(one(&long).starts_with("normal: its length is 2.00"));
    let turned = mapped(room(CAMERA), NORMAL, |[x, y, z]| [x, z, -y]);
    assert!(one(&turned).contains("normals in camera space and positions in world space"));
    let camera = mapped(room(CAMERA), POSITIONS, |p| difference(p, CAMERA));
    assert!(one(&camera).contains("normals and positions in camera space"));
    let shifted = mapped(room(CAMERA), TEXTURE1, |t| t.map(|x| x - 1.0));
    assert!(one(&shifted).starts_with("texture1: its minimum is -0.50"));
}

/// A scene around the origin in world space: all its normals face the origin, where no camera is.
#[test]
fn normals_that_face_the_origin_of_the_world_cause_no_warning() {
    let centred = mapped(room(CAMERA), POSITIONS, |p| {
        difference(p, [1.0, 40.0, 20.0])
    });
    assert_eq!(found(&centred), [""; 0]);
    let wall = mapped(room([1.0, 50.0, 4.0]), POSITIONS, |p| difference(p, CAMERA));
    assert_eq!(found(&wall), [""; 0], "a wall alone tells nothing");
}

#[test]
fn both_swapped_buffers_are_named() {
    let mut frame = mapped(room(CAMERA), NORMAL, |[x, y, z]| [x, -y, z]);
    let pixels = SIDE * SIDE;
    for i in 0..3 * pixels {
        frame
            .features
            .swap(NORMAL * pixels + i, TEXTURE1 * pixels + i);
    }
    let found = found(&frame);
    assert!(
        found[0].starts_with("normal: its length is 0.87"),
        "{found:?}"
    );
    assert!(
        found[1].starts_with("texture1: its minimum is -1.00"),
        "{found:?}"
    );
}

#[test]
fn an_empty_or_tiny_image_causes_no_warning() {
    let mut frame = mapped(room(CAMERA), NORMAL, |n| n.map(|x| 2.0 * x));
    frame.mask = Some(vec![0.0; SIDE * SIDE]);
    assert_eq!(found(&frame), [""; 0]);
    for (width, height) in [(1, 1), (2, 40)] {
        let pixels = width * height;
        let tiny = Frame {
            width,
            height,
            color: vec![0.5; 3 * pixels],
            features: vec![2.0; FEATURES * pixels],
            mask: None,
            ..room(CAMERA)
        };
        assert_eq!(found(&tiny), [""; 0]);
    }
}
