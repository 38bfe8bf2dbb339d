"""Meshes and prints of objects on walls, ceilings and floors, by the name of their kind; they are no obstacles."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, pi, sin

import cv2

from sim_hil.scene.scene import SceneObject
from sim_hil.world.drawing import prints, textures
from sim_hil.world.drawing.kit import STEEL, Drawing, Kit, plate
from sim_hil.world.drawing.textures import DARK, WHITE, Image, canvas, fill, front, plain, rgb, write


def _double_door_face(thing: SceneObject) -> Image:
    image = front(thing, 0.55)
    for left in (0.03, 0.505):
        fill(image, left, 0.03, left + 0.465, 1, rgb(thing.colour))
        fill(image, left, 0.86, left + 0.465, 1, (176, 180, 184))
        centre = (round((left + 0.232) * image.shape[1]), round(0.27 * image.shape[0]))
        cv2.circle(image, centre, round(0.09 * image.shape[0]), (206, 226, 232), -1)
        cv2.circle(image, centre, round(0.09 * image.shape[0]), DARK, 3)
    for left in (0.40, 0.54):
        fill(image, left, 0.48, left + 0.06, 0.62, (200, 204, 208))
    if thing.text:
        fill(image, 0.1, 0.40, 0.9, 0.46, WHITE)
        write(image, thing.text, 0.12, 0.405, 0.88, 0.455, DARK)
    return image


def _elevator_face(thing: SceneObject) -> Image:
    _, width, height = thing.size_m
    image = canvas(width, height, (96, 100, 106))
    fill(image, 0.0, 0.0, 1.0, 0.16, (30, 34, 40))
    write(image, thing.text or "ELEVATOR", 0.05, 0.02, 0.66, 0.14, (255, 216, 110))
    fill(image, 0.72, 0.025, 0.95, 0.135, (10, 10, 10))
    write(image, "1 ^", 0.74, 0.035, 0.93, 0.125, (255, 70, 50))
    for left, tone in ((0.06, 1.05), (0.435, 0.95)):
        fill(image, left, 0.19, left + 0.365, 1.0, rgb(thing.colour, tone))
        for stripe in range(4):
            x = left + 0.04 + 0.09 * stripe
            fill(image, x, 0.19, x + 0.012, 1.0, rgb(thing.colour, tone * 1.18))
    fill(image, 0.425, 0.19, 0.435, 1.0, (20, 20, 22))
    fill(image, 0.85, 0.48, 0.96, 0.66, (200, 204, 208))
    for y in (0.53, 0.61):
        cv2.circle(image, (round(0.905 * image.shape[1]), round(y * image.shape[0])), 5, (250, 170, 40), -1)
    return image


def _loading_face(thing: SceneObject) -> Image:
    image = front(thing)
    rows = image.shape[0]
    for top in range(0, rows, 14):
        image[top : top + 4] = rgb(thing.colour, 0.82)
    for k in range(16):
        tone = (240, 190, 20) if k % 2 else DARK
        fill(image, 0.0, k / 16, 0.07, (k + 1) / 16, tone)
        fill(image, 0.93, k / 16, 1.0, (k + 1) / 16, tone)
    fill(image, 0.0, 0.0, 1.0, 0.06, (240, 190, 20))
    fill(image, 0.30, 0.16, 0.70, 0.46, WHITE)
    write(image, thing.text or "DOCK", 0.33, 0.19, 0.67, 0.43, (30, 60, 140))
    return image


def _whiteboard_face(thing: SceneObject) -> Image:
    _, width, height = thing.size_m
    image = canvas(width, height, (168, 172, 176))
    fill(image, 0.02, 0.03, 0.98, 0.95, rgb(thing.colour))
    write(image, thing.text or "PLAN", 0.06, 0.07, 0.46, 0.28, (30, 60, 190))
    for row, colour in enumerate(((200, 40, 40), (40, 130, 60), (40, 60, 190), (60, 60, 60))):
        fill(image, 0.06, 0.36 + 0.13 * row, 0.40 - 0.05 * (row % 2), 0.39 + 0.13 * row, colour)
    h, w = image.shape[:2]
    cv2.circle(image, (round(0.68 * w), round(0.35 * h)), round(0.14 * h), (200, 40, 40), 4)
    cv2.rectangle(image, (round(0.58 * w), round(0.60 * h)), (round(0.84 * w), round(0.85 * h)), (40, 130, 60), 4)
    cv2.line(image, (round(0.68 * w), round(0.49 * h)), (round(0.70 * w), round(0.60 * h)), (60, 60, 60), 4)
    return image


def _painting_face(thing: SceneObject) -> Image:
    image = front(thing)
    h, w = image.shape[:2]
    fill(image, 0.08, 0.10, 0.92, 0.90, (240, 190, 130))
    cv2.circle(image, (round(0.68 * w), round(0.36 * h)), round(0.12 * h), (250, 236, 170), -1)
    cv2.ellipse(
        image, (round(0.3 * w), round(0.66 * h)), (round(0.24 * w), round(0.2 * h)), 0, 180, 360, (90, 80, 140), -1
    )
    cv2.ellipse(
        image, (round(0.68 * w), round(0.68 * h)), (round(0.24 * w), round(0.14 * h)), 0, 180, 360, (60, 110, 90), -1
    )
    fill(image, 0.08, 0.66, 0.92, 0.90, (70, 140, 180))
    return image


def _clock_face(thing: SceneObject) -> Image:
    image = plain(96, 96, rgb(thing.colour))
    cv2.rectangle(image, (0, 0), (95, 95), DARK, 5)
    for hour in range(12):
        turn = 2 * pi * hour / 12
        at = [(round(48 + r * sin(turn)), round(48 - r * cos(turn))) for r in (36, 43)]
        cv2.line(image, at[0], at[1], DARK, 4)
    cv2.line(image, (48, 48), (26, 34), DARK, 6)
    cv2.line(image, (48, 48), (78, 28), DARK, 4)
    return image


def _room_face(thing: SceneObject) -> Image:
    image = plain(128, 96, rgb(thing.colour))
    fill(image, 0.0, 0.86, 1.0, 1.0, (230, 180, 60))
    write(image, thing.text or "-", 0.06, 0.12, 0.94, 0.78, WHITE)
    return image


def _exit_face(thing: SceneObject) -> Image:
    image = plain(256, 104, rgb(thing.colour))
    write(image, thing.text or "EXIT", 0.04, 0.10, 0.66, 0.90, WHITE)
    cv2.arrowedLine(image, (178, 52), (244, 52), WHITE, 10, tipLength=0.45)
    return image


def _carpet_top(thing: SceneObject) -> Image:
    depth, width, _ = thing.size_m
    image = canvas(width, depth, rgb(thing.colour))
    h, w = image.shape[:2]
    gold = rgb((0.86, 0.70, 0.34))
    cv2.rectangle(image, (w // 16, h // 16), (w - w // 16, h - h // 16), gold, max(w // 40, 2))
    lozenge = ((w // 2, h // 5), (w - w // 5, h // 2), (w // 2, h - h // 5), (w // 5, h // 2))
    for (x0, y0), (x1, y1) in zip(lozenge, (*lozenge[1:], lozenge[0]), strict=True):
        cv2.line(image, (x0, y0), (x1, y1), gold, max(w // 30, 3))
    cv2.circle(image, (w // 2, h // 2), min(w, h) // 10, gold, -1)
    return image


def _two_sided(drawing: Drawing) -> Callable[[Kit], None]:
    """Build a sign that hangs from the ceiling, readable from both sides."""

    def build(kit: Kit) -> None:
        face = kit.picture(drawing)
        kit.whole(kit.paint(0.6), face, back=face)

    return build


def carpet(kit: Kit) -> None:
    kit.whole(kit.paint(), top=kit.picture(_carpet_top))


def handrail(kit: Kit) -> None:
    kit.part((-0.2, 0.5), (-0.5, 0.5), (0.92, 1.0), kit.paint())
    for k in range(max(round(kit.width / 1.2), 2)):
        y = -0.46 + 0.92 * k / (max(round(kit.width / 1.2), 2) - 1)
        kit.part((-0.5, 0.2), (y - 0.01, y + 0.01), (0.86, 0.92), STEEL)


def light(kit: Kit) -> None:
    kit.whole(kit.paint())


door = plate(textures.door)
double_door = plate(_double_door_face)
elevator = plate(_elevator_face)
loading_door = plate(_loading_face)
window = plate(textures.window)
notice_board = plate(textures.notice_board)
whiteboard = plate(_whiteboard_face)
screen = plate(prints.chart)
painting = plate(_painting_face)
clock = plate(_clock_face)
room_sign = plate(_room_face)
sign = _two_sided(textures.sign)
exit_sign = _two_sided(_exit_face)
