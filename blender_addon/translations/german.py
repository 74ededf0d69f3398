# SPDX-License-Identifier: GPL-3.0-or-later
"""German."""

from __future__ import annotations

WORDS = {
    # Garment
    "Garment": "Kleidungsstück",
    "Armature": "Skelett",
    "Armature of the character that wears the garment; found by its Armature modifier when empty": (
        "Skelett der Figur, die das Kleidungsstück trägt; leer: das seines Skelett-Modifikators"
    ),
    "Choose Garment": "Kleidungsstück wählen",
    "Work on this garment": "An diesem Kleidungsstück arbeiten",
    "Name of the object to work on": "Name des Objekts, an dem gearbeitet wird",
    "Move Layer": "Lage verschieben",
    "Wear this garment further inside or further outside": (
        "Dieses Kleidungsstück weiter innen oder weiter außen tragen"
    ),
    "Where": "Wohin",
    "Which way it goes in the order": "Wohin es in der Reihenfolge rückt",
    "Inner": "Innen",
    "Nearer to the skin": "Näher an der Haut",
    "Outer": "Außen",
    "Farther from the skin": "Weiter weg von der Haut",
    "Train Outfit": "Alle trainieren",
    "Train the garments of the character that need it, inner ones first, each over those beneath it": (
        "Die Kleidungsstücke der Figur trainieren, die es brauchen, innere zuerst, jedes über denen darunter"
    ),
    "Bake Outfit": "Alle backen",
    "Bake all garments of the character over the scene's frames, as bones and shape keys": (
        "Alle Kleidungsstücke der Figur über die Bilder der Szene backen, als Knochen und Formschlüssel"
    ),
    "Hide Covered by Outfit": "Unter allen verbergen",
    "Hide faces of the body, and of inner garments, that a garment covers in every frame, a last resort": (
        "Flächen des Körpers und innerer Kleidungsstücke verbergen, die ein Kleidungsstück in jedem Bild bedeckt, "
        "als letzter Ausweg"
    ),
    "Take no further garment; what was done stays": (
        "Kein weiteres Kleidungsstück mehr nehmen; was getan ist, bleibt"
    ),
    "Attach to Cloth": "Am Stoff befestigen",
    "Let the other selected objects ride on the garment: each is parented to the three vertices beneath it": (
        "Die anderen ausgewählten Objekte reiten auf dem Kleidungsstück: jedes hängt an den drei Eckpunkten unter ihm"
    ),
    "Bodies": "Körper",
    "Meshes that the garment collides with; all others bound to the armature when empty": (
        "Netze, mit denen das Kleidungsstück kollidiert; leer: alle anderen, die an das Skelett gebunden sind"
    ),
    # Try on
    "Try On": "Anprobieren",
    "Which other body it is tried on": "An welchem anderen Körper es anprobiert wird",
    "Show a copy of the garment on another body, beside the character; the garment itself stays as it is": (
        "Eine Kopie des Kleidungsstücks an einem anderen Körper zeigen, neben der Figur; das Kleidungsstück selbst "
        "bleibt, wie es ist"
    ),
    "Stop Trying On": "Anprobe beenden",
    "Remove what shows the garment on another body": "Entfernen, was es an einem anderen Körper zeigt",
    "Add Shape Key": "Formschlüssel hinzufügen",
    "Add a shape key that makes the body to try on": (
        "Einen Formschlüssel hinzufügen, der den anderen Körper ausmacht"
    ),
    "Remove Shape Key": "Formschlüssel entfernen",
    "Take this shape key from the list; the body keeps it": (
        "Diesen Formschlüssel aus der Liste nehmen; der Körper behält ihn"
    ),
    "Body": "Körper",
    "Where the body to try on comes from": "Woher der andere Körper kommt",
    "Shape Keys": "Formschlüssel",
    "The character's own bodies with other values of their shape keys": (
        "Die Körper der Figur mit anderen Werten ihrer Formschlüssel"
    ),
    "USD Stage": "USD-Stage",
    "Another character with the same joints, and bodies with the same points and faces": (
        "Eine andere Figur mit denselben Gelenken, und Körpern mit denselben Punkten und Flächen"
    ),
    "Shape Key": "Formschlüssel",
    "Shape key of a body; all bodies that have it": "Formschlüssel eines Körpers; alle Körper, die ihn haben",
    "Value": "Wert",
    "Value of the shape key on the body to try on": "Wert des Formschlüssels am anderen Körper",
    "Stage": "Stage",
    "USD file of another character of the family; followed by :/Root where it holds several": (
        "USD-Datei einer anderen Figur der Familie; gefolgt von :/Wurzel, wenn sie mehrere enthält"
    ),
    "Share": "Anteil",
    "0 is the body that the garment was fitted to, 1 the other one": (
        "0 ist der Körper, dem das Kleidungsstück angepasst wurde, 1 der andere"
    ),
    # Fabric
    "Fabric": "Stoff",
    "Match Bones": "Knochen zuordnen",
    "Bone": "Knochen",
    "Find bones that were renamed since the training, and list those that only you can tell": (
        "Knochen finden, die seit dem Training umbenannt wurden, und auflisten, die nur Sie zuordnen können"
    ),
    "What this bone of the training is called now; empty where it is not chosen": (
        "Wie dieser Knochen des Trainings jetzt heißt; leer: nicht gewählt"
    ),
    "What the garment is made of": "Woraus das Kleidungsstück besteht",
    "Preset": "Vorgabe",
    "Cloth to start from; sets all values": "Stoff, von dem ausgegangen wird; setzt alle Werte",
    "Default": "Standard",
    "Light and soft": "Leicht und weich",
    "The paper's energy of contact, which depends on the mesh": "Der Kontakt des Artikels, der vom Netz abhängt",
    "Contact": "Kontakt",
    "Contact Model": "Kontaktmodell",
    "What the body pushes away": "Was der Körper wegdrückt",
    "The body pushes each area of the cloth, whatever its mesh": "Der Körper drückt jede Fläche, gleich welches Netz",
    "The body pushes each vertex, as in the paper; a coarse mesh resists less": (
        "Der Körper drückt jeden Eckpunkt, wie im Artikel; ein grobes Netz hält weniger stand"
    ),
    "Loose Contact": "Kontakt des Losen",
    "The same of loose cloth; a soft one slides off hands": "Ebenso bei losem Stoff; weich gleitet er von Händen ab",
    "Tether": "Halt",
    "How firmly tight cloth stays over its skin, in N/m³; zero lets it slide": (
        "Wie fest enger Stoff über seiner Haut bleibt, in N/m³; null lässt ihn gleiten"
    ),
    "Stitch": "Naht",
    "How firmly parts that lie on others hold there, such as straps and pockets, in N/m³; zero lets them part": (
        "Wie fest Teile halten, die auf anderen liegen, etwa Träger und Taschen, in N/m³; null lässt sie auseinander"
    ),
    "Thickness": "Dicke",
    "Paper": "Artikel",
    "Surface": "Fläche",
    "Vertex": "Eckpunkt",
    "Gap between cloth and body at which the body begins to push": (
        "Abstand zwischen Stoff und Körper, ab dem der Körper drückt"
    ),
    "Thickness of the cloth, whose mesh lies in its middle": "Dicke des Stoffs, dessen Netz in seiner Mitte liegt",
    "How hard the body pushes each area away at the skin, in N/m³": (
        "Wie stark der Körper jede Fläche an der Haut wegdrückt, in N/m³"
    ),
    "Silk": "Seide",
    "Light and very soft, 80 g/m²": "Leicht und sehr weich, 80 g/m²",
    "Cotton": "Baumwolle",
    "A shirt, 150 g/m²": "Ein Hemd, 150 g/m²",
    "Denim": "Jeansstoff",
    "Very stiff and heavy, 400 g/m²": "Sehr steif und schwer, 400 g/m²",
    "Wool": "Wolle",
    "A coat, soft and heavy, 300 g/m²": "Ein Mantel, weich und schwer, 300 g/m²",
    "Leather": "Leder",
    "Stiff and very heavy, 600 g/m²": "Steif und sehr schwer, 600 g/m²",
    "Stretch Model": "Dehnungsmodell",
    "How the cloth resists stretching": "Wie der Stoff sich gegen Dehnung wehrt",
    "Membrane with Lamé parameters": "Membran mit Lamé-Parametern",
    "Stretch along the threads and shear across, by texture coordinates": (
        "Dehnung längs und Scherung quer zu den Fäden, nach Texturkoordinaten"
    ),
    "Density": "Flächengewicht",
    "Mass for each area, in kg/m²": "Masse je Fläche, in kg/m²",
    "Lamé μ": "Lamé-μ",
    "Resistance to shear of the membrane, in N/m": "Widerstand der Membran gegen Scherung, in N/m",
    "Lamé λ": "Lamé-λ",
    "Resistance to changes of area of the membrane, in N/m": (
        "Widerstand der Membran gegen Änderungen der Fläche, in N/m"
    ),
    "Stretch": "Dehnung",
    "Stiffness along the threads, in N/m": "Steifigkeit längs der Fäden, in N/m",
    "Shear": "Scherung",
    "Stiffness across the threads, in N/m": "Steifigkeit quer zu den Fäden, in N/m",
    "Bending": "Biegung",
    "Stiffness of folds, in N m": "Steifigkeit von Falten, in N m",
    "Collision": "Kollision",
    "How hard the body pushes each vertex away, in N/m": "Wie stark der Körper jeden Punkt wegdrückt, in N/m",
    "Margin": "Abstand",
    "Air Drag": "Luftwiderstand",
    "Resistance of the air for each area and speed, in kg/(m² s); zero is a vacuum": (
        "Widerstand der Luft je Fläche und Geschwindigkeit, in kg/(m² s); null ist luftleer"
    ),
    # The Python outside
    "Check Python": "Python prüfen",
    "Ask the chosen Python for its versions and its device": "Das gewählte Python nach Versionen und Gerät fragen",
    "Find Python": "Python suchen",
    "Look for a Python that has ssilk: on the PATH, in common environments, beside the blend file": (
        "Ein Python mit ssilk suchen: im PATH, in üblichen Umgebungen, neben der Blend-Datei"
    ),
    "Interpreter of the environment in which ssilk is installed": (
        "Interpreter der Umgebung, in der ssilk installiert ist"
    ),
    "Install From": "Installieren aus",
    "A wheel of ssilk, or the folder of its project, to make an environment from; "
    "what came with the extension when empty": (
        "Ein Wheel von ssilk oder der Ordner des Projekts für eine neue Umgebung; leer: was der Erweiterung beiliegt"
    ),
    "Create": "Anlegen",
    "Create Environment for SSILK": "Umgebung für SSILK anlegen",
    "Make a Python environment for ssilk, with what pip downloads: up to several gigabytes with PyTorch": (
        "Eine Python-Umgebung für ssilk anlegen, mit dem, was pip lädt: mit PyTorch bis zu einige Gigabyte"
    ),
    "Stop Trainings with Blender": "Training mit Blender beenden",
    "End trainings when Blender closes; otherwise they go on. The best model is kept either way": (
        "Training beenden, wenn Blender schließt; sonst läuft es weiter. Das beste Modell bleibt in beiden Fällen"
    ),
    "Cancel": "Abbrechen",
    "Stop what runs outside Blender": "Beenden, was außerhalb von Blender läuft",
    # Preflight
    "Preflight": "Vorprüfung",
    "Inspect": "Prüfen",
    "Look for what would spoil the training: on the mesh, its fit, its classes, and the motions that are chosen": (
        "Suchen, was das Training verdirbt: am Netz, am Sitz, an den Klassen und an den gewählten Bewegungen"
    ),
    "Select": "Auswählen",
    "Select what the finding is about, or go to the first frame in question": (
        "Auswählen, worum es in dem Befund geht, oder zum ersten fraglichen Bild gehen"
    ),
    "Fix": "Beheben",
    "Repair what was found, where that needs no decision; look again afterwards": (
        "Beheben, was gefunden wurde, wo nichts zu entscheiden ist; danach neu prüfen"
    ),
    "Push Out": "Herausdrücken",
    "Settle the garment out of the body and off garments beneath, with little change of shape, and all shape keys": (
        "Das Kleidungsstück mit wenig Formänderung aus dem Körper und von Kleidungsstücken darunter drücken, mit "
        "allen Formschlüsseln"
    ),
    # Classes
    "Class": "Klasse",
    "Classes": "Klassen",
    "Pinned": "Fest",
    "Rigidly follows the skeleton, black: belts, collars, what is sewn on": (
        "Folgt starr dem Skelett, schwarz: Gürtel, Kragen, Angenähtes"
    ),
    "Tight": "Eng",
    "Follows the body closely, red": "Folgt dem Körper dicht, rot",
    "Loose": "Lose",
    "Moves freely, green: moved by proxy joints and the network": (
        "Bewegt sich frei, grün: durch Stellvertreter-Knochen und das Netzwerk"
    ),
    "Classify Automatically": "Automatisch einteilen",
    "Find classes by the garment's distance to the body and by where limbs part; replaces what is painted": (
        "Klassen finden nach dem Abstand zum Körper und danach, wo Glieder sich trennen; ersetzt Gemaltes"
    ),
    "Paint Classes": "Klassen malen",
    "Paint vertex classes with Blender's vertex-paint brushes: pinned black, tight red, loose green": (
        "Klassen mit Blenders Pinseln malen: fest schwarz, eng rot, lose grün"
    ),
    "Paint This Class": "Diese Klasse malen",
    "Paint this class from now on": "Von jetzt an diese Klasse malen",
    "Fill Selection": "Auswahl füllen",
    "Give the selected vertices this class": "Den ausgewählten Punkten diese Klasse geben",
    "Take Up Painting": "Gemaltes übernehmen",
    "Turn painted colours into classes, each into the nearest one, and make the colours pure again": (
        "Aus gemalten Farben Klassen machen, je die nächste, und die Farben wieder rein machen"
    ),
    "Class Overlay": "Klassen einblenden",
    "Show the classes of all garments over them in 3D views, in any mode; the file is not touched": (
        "Die Klassen aller Kleidungsstücke in 3D-Ansichten darüberlegen, in jedem Modus; die Datei bleibt unberührt"
    ),
    "Show Classes": "Klassen zeigen",
    "Show classes as colours, made again from the stored ones; in Solid shading, in this view": (
        "Klassen als Farben zeigen, neu aus den gespeicherten; in fester Schattierung, in dieser Ansicht"
    ),
    "Mirror Classes": "Klassen spiegeln",
    "Give one side the classes of the other, by the places of vertices along the garment's own x axis": (
        "Einer Seite die Klassen der anderen geben, nach der Lage der Punkte längs der x-Achse des Kleidungsstücks"
    ),
    "From": "Von",
    "Left (+x)": "Links (+x)",
    "From the character's left": "Von links, aus Sicht der Figur",
    "Right (-x)": "Rechts (-x)",
    "From its right": "Von rechts, aus ihrer Sicht",
    "Tolerance": "Toleranz",
    "How far from the mirrored place a vertex may lie": (
        "Wie weit ein Punkt vom gespiegelten Ort entfernt sein darf"
    ),
    # Rig
    "Proxy Rig": "Stellvertreter-Rig",
    "Generate Proxy Rig": "Stellvertreter-Rig erzeugen",
    "Make proxy bones for the loose part, if there is one, and weights for the whole garment, from its classes": (
        "Aus den Klassen Stellvertreter-Knochen für den losen Teil machen, falls es ihn gibt, und Gewichte für alles"
    ),
    "Proxies": "Stellvertreter",
    "Proxy bones on the loose part": "Stellvertreter-Knochen auf dem losen Teil",
    "Roots per Cluster": "Wurzeln je Teil",
    "How many proxies of each connected loose part hang from the character's bones directly": (
        "Wie viele Stellvertreter jedes zusammenhängenden losen Teils direkt an Knochen der Figur hängen"
    ),
    "Keep Edits by Hand": "Handarbeit behalten",
    "Keep proxies that were moved, reparented or added, leave out those that were deleted, and keep "
    "the weights of repainted vertices": (
        "Behalten, was verschoben, umgehängt oder hinzugefügt wurde, Gelöschtes weglassen, gemalte Gewichte behalten"
    ),
    "Adopt Rig": "Rig übernehmen",
    "Recognise the proxies of garments that were imported from a stage of `ssilk rig`": (
        "Die Stellvertreter von Kleidungsstücken erkennen, die aus einer Datei von `ssilk rig` importiert wurden"
    ),
    "Import Rigged Stage": "Fertiges Rig importieren",
    "Import a dressed character that `ssilk rig` wrote, with its proxies and its frame rate": (
        "Eine bekleidete Figur importieren, die `ssilk rig` schrieb, mit Stellvertretern und Bildrate"
    ),
    "USD file that ssilk wrote": "USD-Datei, die ssilk schrieb",
    # All at once, help, failures
    "Make It Move": "In Bewegung setzen",
    "Classify, rig, choose motions, train, and play it live: it gets better until you finish the training": (
        "Klassen finden, Rig erzeugen, Bewegungen wählen, trainieren und live spielen: Es wird besser, bis Sie das "
        "Training beenden"
    ),
    "Finish": "Fertig",
    "Preferences": "Einstellungen",
    "Stop Here": "Hier aufhören",
    "Take no further step; what was done stays, and a training goes on": (
        "Keinen weiteren Schritt tun; was getan ist, bleibt, und ein Training läuft weiter"
    ),
    "Dismiss": "Ausblenden",
    "Take this message away": "Diese Meldung wegnehmen",
    "Help": "Hilfe",
    "Open the guide at what it says of this panel": "Die Anleitung dort öffnen, wo sie von diesem Bereich spricht",
    # Training
    "Add Demo Motions": "Demo-Bewegungen hinzufügen",
    "Give a two-legged character that nothing moves the demo's motions as actions: it walks, runs, jumps, turns": (
        "Einer zweibeinigen Figur, die nichts bewegt, die Bewegungen der Demo als Aktionen geben: Sie geht, läuft, "
        "springt und dreht sich"
    ),
    "Choose": "Wählen",
    "Choose Motions": "Bewegungen wählen",
    "Choose all motions that are listed, or none of them": "Alle Bewegungen der Liste wählen, oder keine davon",
    "All": "Alle",
    "Train on all that are listed": "Mit allen trainieren, die in der Liste stehen",
    "None": "Keine",
    "Train on none of them": "Mit keiner davon trainieren",
    "Filter": "Filter",
    "List only motions with this in their names; All and None then choose among these": (
        "Nur Bewegungen auflisten, in deren Namen das steht; Alle und Keine wählen dann unter diesen"
    ),
    "Energies": "Energien",
    "Nothing was computed yet": "Noch wurde nichts berechnet",
    "Training": "Training",
    "How the garment is trained": "Wie das Kleidungsstück trainiert wird",
    "Motions": "Bewegungen",
    "What can be trained on": "Womit trainiert werden kann",
    "Find Motions": "Bewegungen suchen",
    "List what the armature plays: the timeline, its actions, its NLA strips; what was chosen stays chosen": (
        "Auflisten, was das Skelett spielt: Zeitleiste, Aktionen, NLA-Streifen; Gewähltes bleibt gewählt"
    ),
    "Add Motion Files": "Dateien hinzufügen",
    "Train on animations of this skeleton in USD files, too": (
        "Auch mit Animationen dieses Skeletts aus USD-Dateien trainieren"
    ),
    "Remove Motion": "Bewegung entfernen",
    "Take this motion off the list": "Diese Bewegung von der Liste nehmen",
    "Kind": "Art",
    "Timeline": "Zeitleiste",
    "All that the armature plays over the scene's frame range": (
        "Alles, was das Skelett im Bildbereich der Szene spielt"
    ),
    "Action": "Aktion",
    "One of the armature's actions by itself": "Eine Aktion des Skeletts für sich",
    "Strip": "Streifen",
    "One strip of the armature's NLA tracks by itself": "Ein Streifen der NLA-Spuren des Skeletts für sich",
    "File": "Datei",
    "A USD file with an animation of this skeleton": "Eine USD-Datei mit einer Animation dieses Skeletts",
    "Track": "Spur",
    "NLA track of the strip": "NLA-Spur des Streifens",
    "Use": "Verwenden",
    "Train on this motion": "Mit dieser Bewegung trainieren",
    "Draft": "Entwurf",
    "A first look, after minutes on any machine": "Ein erster Eindruck, nach Minuten auf jedem Rechner",
    "Preview": "Vorschau",
    "Nearly the final quality, after minutes on a GPU": "Fast die endgültige Qualität, nach Minuten auf einer GPU",
    "The paper's own model and training, for comparison; far slower": (
        "Modell und Training wie im Paper, zum Vergleich; viel langsamer"
    ),
    "Light": "Leicht",
    "A small network for many characters, after minutes on a GPU": (
        "Ein kleines Netz für viele Figuren, nach Minuten auf einer GPU"
    ),
    "Final": "Endgültig",
    "What shots are made with, after ten to twenty minutes on a fast GPU": (
        "Womit Einstellungen entstehen, nach zehn bis zwanzig Minuten auf einer schnellen GPU"
    ),
    "Iterations": "Schritte",
    "Optimiser steps; zero for as many as the preset has": "Schritte des Optimierers; null: so viele wie die Vorgabe",
    "Minutes": "Minuten",
    "Wall time to fill with as many steps as fit, in place of the preset's; zero for these": (
        "Zeit, die mit so vielen Schritten gefüllt wird, wie hineinpassen, statt denen der Vorgabe; null: diese"
    ),
    "Free": "Frei",
    "How much the network moves the garment: at 0 its bones carry it. Keyed, it holds the garment and lets it go": (
        "Wie sehr das Netzwerk das Kleidungsstück bewegt: bei 0 tragen es seine Knochen. Mit Keyframes wird es "
        "gehalten und losgelassen"
    ),
    "Colliders": "Kollisionsobjekte",
    "Meshes that the garment meets besides its bodies, with Collision physics or without": (
        "Netze, auf die das Kleidungsstück außer seinen Körpern trifft, mit der Physik Kollision oder ohne"
    ),
    "As Trained": "Wie trainiert",
    "The fabric of its training": "Der Stoff seines Trainings",
    "Played Fabric": "Gespielter Stoff",
    "What the garment is played and baked as": "Als welcher Stoff gespielt und gebacken wird",
    "Cloth to play; sets all factors": "Stoff, der gespielt wird; setzt alle Faktoren",
    "How much stiffer the cloth is than in its training": "Wie viel steifer der Stoff ist als in seinem Training",
    "How much stiffer it is against shear, beside Stretch": "Wie viel steifer er gegen Scherung ist, neben Dehnung",
    "How much stiffer folds are than in its training": "Wie viel steifer Falten sind als in seinem Training",
    "How much heavier the cloth is than in its training": "Wie viel schwerer der Stoff ist als in seinem Training",
    "How much more the air holds it than in its training": "Wie viel mehr die Luft ihn hält als in seinem Training",
    "Friction": "Reibung",
    "Coulomb's coefficient of the cloth, 0.2 to 1 on skin; bakes as Hero know it": (
        "Coulombscher Reibungsbeiwert des Stoffs, auf Haut 0,2 bis 1; gilt, wenn als Hauptfigur gebacken wird"
    ),
    "Range of Fabrics": "Viele Stoffe",
    "Train for soft and stiff, light and heavy cloth at once, as all presets are, so that the fabric can be chosen "
    "while the garment is played": (
        "Zugleich für weichen und steifen, leichten und schweren Stoff trainieren, wie es alle Vorgaben sind, sodass "
        "der Stoff beim Abspielen gewählt werden kann"
    ),
    "Part": "Teil",
    "Vertex group that has a slider of its own: the proxies that move it are held with it": (
        "Vertexgruppe mit einem eigenen Regler: Die Proxys, die sie bewegen, werden mit ihr gehalten"
    ),
    "Part Free": "Teil frei",
    "How much the network moves the vertex group: at 0 its bones carry it": (
        "Wie sehr das Netzwerk die Vertexgruppe bewegt: bei 0 tragen sie ihre Knochen"
    ),
    "Posed By": "Posiert von",
    "Action with keys of proxies, which these follow as far as their slider Posed says": (
        "Aktion mit Keyframes von Proxys; diese folgen ihr so weit, wie ihr Regler „Posiert“ sagt"
    ),
    "How much the network moves this proxy: at 0 it goes where the garment's bones carry its cloth": (
        "Wie sehr das Netzwerk diesen Proxy bewegt: bei 0 geht er dorthin, wo Knochen seinen Stoff tragen"
    ),
    "Posed": "Posiert",
    "How far this proxy follows the action that poses proxies by hand (Posed By)": (
        "Wie weit dieser Proxy der Aktion folgt, die Proxys von Hand posiert (Posiert von)"
    ),
    "Held Proxy": "Gehaltener Proxy",
    "Hold Frames": "Bilder halten",
    "For how many frames each pose of the garment is held: 2 for animation on twos": (
        "Wie viele Bilder lang jede Pose des Kleidungsstücks gehalten wird: 2 für Animation auf Zweiern"
    ),
    "Loop": "Schleife",
    "The motion is a cycle: a bake plays it until the garment repeats, and its last frame flows into its first": (
        "Die Bewegung ist ein Zyklus: Gebacken wird, wenn sich das Kleidungsstück wiederholt, und das letzte Bild "
        "geht in das erste über"
    ),
    "Certify": "Zertifizieren",
    "Move baked frames as little as it takes until the garment does not pass through itself and no skin shows that "
    "it covers; other garments of an outfit are not looked at. A wrong frame takes seconds": (
        "Gebackene Bilder so wenig wie nötig bewegen, bis das Kleidungsstück sich nicht mehr durchdringt und keine "
        "Haut durchscheint, die es bedeckt; andere Kleidungsstücke der Figur werden nicht betrachtet. Ein falsches "
        "Bild dauert Sekunden"
    ),
    "Tightness": "Enge",
    "How much of the garment is tight: nothing but what is pinned, or all; replaces what is painted, once classes "
    "were found automatically": (
        "Wie viel des Kleidungsstücks anliegt: nichts, was nicht fest ist, oder alles; ersetzt, was gemalt ist, "
        "sobald Klassen automatisch gefunden wurden"
    ),
    "Stiffer": "Steifer",
    "By": "Um",
    "Vertex group in which the cloth is stiffer, such as a collar, or softer; weights lie between": (
        "Vertexgruppe, in der der Stoff steifer ist, etwa ein Kragen, oder weicher; Gewichte liegen dazwischen"
    ),
    "What stretching and bending are multiplied by where the weight is one; below one it is softer": (
        "Womit Dehnung und Biegung malgenommen werden, wo das Gewicht eins ist; unter eins ist er weicher"
    ),
    "Pins": "Festes",
    "Vertex group of what is pinned when classes are found; the band it hangs from when empty": (
        "Vertexgruppe dessen, was fest ist, wenn Klassen gesucht werden; wenn leer, der Rand, an dem es hängt"
    ),
    "Folder": "Ordner",
    "Folder of the garment's training, relative to the blend file": (
        "Ordner des Trainings dieses Kleidungsstücks, relativ zur Blend-Datei"
    ),
    "Train": "Trainieren",
    "Train the garment on the chosen motions, outside Blender: it continues when Blender closes": (
        "Das Kleidungsstück mit den gewählten Bewegungen außerhalb von Blender trainieren: läuft ohne Blender weiter"
    ),
    "Cancel Training": "Training beenden",
    "End the training; its best model is kept, and it can go on from where it is": (
        "Das Training beenden; sein bestes Modell bleibt, und es kann von hier weitergehen"
    ),
    "End a training whose garment is not in this file any more; its best model is kept": (
        "Ein Training beenden, dessen Kleidungsstück nicht mehr in dieser Datei ist; sein bestes Modell bleibt"
    ),
    "Resume Training": "Training fortsetzen",
    "Let the training go on from where it ended": "Das Training dort fortsetzen, wo es endete",
    # Baking and playback
    "Baking": "Backen",
    "Model": "Modell",
    "Trained model of the garment; that of its own training when empty": (
        "Trainiertes Modell des Kleidungsstücks; leer: das seines eigenen Trainings"
    ),
    "Bake": "Backen",
    "Bake the trained garment over the scene's frames, as bones and shape keys; what was baked before is replaced": (
        "Das trainierte Kleidungsstück über die Bilder der Szene backen, in Knochen und Formschlüssel; ersetzt alte"
    ),
    "To Timeline": "In die Zeitleiste",
    "Put keys on the proxies and on shape keys of the garment": (
        "Schlüsselbilder auf Stellvertreter und Formschlüssel des Kleidungsstücks setzen"
    ),
    "Whole": "Ganz",
    "All that the model has": "Alles, was das Modell hat",
    "Film": "Film",
    "What cannot be told from the whole model": "Vom ganzen Modell nicht zu unterscheiden",
    "Game": "Spiel",
    "For real time: some shapes and proxies, four influences": (
        "Für Echtzeit: einige Formen und Stellvertreter, vier Einflüsse"
    ),
    "Crowd": "Menge",
    "For many characters, far away: few shapes and proxies, four influences": (
        "Für viele Figuren in der Ferne: wenige Formen und Stellvertreter, vier Einflüsse"
    ),
    "Latent": "Latent",
    "The model's own bones and shapes, with motion from a solver; takes a while, and meets no colliders": (
        "Knochen und Formen des Modells selbst, Bewegung von einem Löser; dauert eine Weile, ohne Kollisionsobjekte"
    ),
    "Hero": "Hauptfigur",
    "Carried on by a solver, on bones and shape keys of this shot's own; takes long": (
        "Von einem Löser weitergeführt, auf Knochen und eigenen Formschlüsseln dieses Shots; dauert lange"
    ),
    "To USD": "Nach USD",
    "Write a UsdSkel shot, with the body": "Einen UsdSkel-Shot schreiben, mit dem Körper",
    "USD File": "USD-Datei",
    "Shot to write; named like the garment, beside the blend file, when empty": (
        "Shot, der geschrieben wird; leer: wie das Kleidungsstück benannt, neben der Blend-Datei"
    ),
    "Start From Previous Bake": "Vom vorigen Backen weiter",
    "Begin with the cloth as the bake before this one shows it in the first frame, in place of cloth at rest; the "
    "frames before must have been baked": (
        "Mit dem Stoff beginnen, wie ihn das Backen davor im ersten Bild zeigt, statt mit Stoff in Ruhe; die Bilder "
        "davor müssen gebacken sein"
    ),
    "Pre-Roll": "Vorlauf",
    "How long the garment settles in the first pose before the first frame": (
        "Wie lange das Kleidungsstück sich in der ersten Pose setzt, vor dem ersten Bild"
    ),
    "To Bones": "In Knochen",
    "Turn the garment's simulation or cache into keys of its proxies and shape keys, and switch it off": (
        "Simulation oder Cache des Kleidungsstücks in Schlüsselbilder seiner Stellvertreter und "
        "Formschlüssel umwandeln und abschalten"
    ),
    "Remove Bake": "Gebackenes entfernen",
    "Remove the keys and shape keys that were baked or played live, and give the garment its own weights back": (
        "Gebackene oder live gespielte Schlüsselbilder und Formschlüssel entfernen, eigene Gewichte zurückgeben"
    ),
    "Hide Covered Skin": "Verdeckte Haut ausblenden",
    "Hide faces of the body, and of garments beneath, that the garment covers in every frame, a last resort": (
        "Flächen des Körpers und der Kleidungsstücke darunter ausblenden, die das Kleidungsstück in jedem Bild "
        "bedeckt, als letztes Mittel"
    ),
    "Show Covered Skin": "Verdeckte Haut zeigen",
    "Show the skin under the garment again, and cloth beneath it": (
        "Haut und Stoff unter dem Kleidungsstück wieder zeigen"
    ),
    "Live Playback": "Live-Wiedergabe",
    "What is played live": "Was live gespielt wird",
    "Network": "Netzwerk",
    "The network's own motion, at once": "Die Bewegung des Netzwerks selbst, sofort",
    "As Bake solves it: in the Python with ssilk, frame by frame in the background; meets no colliders": (
        "Wie beim Backen gelöst: im Python mit ssilk, Bild für Bild im Hintergrund; ohne Kollisionsobjekte"
    ),
    "Latent, Few Elements": "Latent, wenige Elemente",
    "Likewise in a quarter of the time, on a sample of the cloth: less exact": (
        "Ebenso in einem Viertel der Zeit, auf einer Auswahl des Stoffs: weniger genau"
    ),
    "Play Live": "Live spielen",
    "Play the trained garment on the armature as it is, frame by frame, without a bake": (
        "Das trainierte Kleidungsstück auf dem Skelett spielen, wie es ist, Bild für Bild, ohne zu backen"
    ),
    "Stop Playing": "Wiedergabe beenden",
    "Play the garment no longer; it stays as it is in this frame": (
        "Das Kleidungsstück nicht länger spielen; es bleibt wie in diesem Bild"
    ),
    "Read Motion Again": "Bewegung neu lesen",
    "Read what the armature does over the scene's frames again: after edits, or when the frame range changed": (
        "Neu lesen, was das Skelett über die Bilder der Szene tut: nach Änderungen, oder bei anderem Bildbereich"
    ),
    "Quality": "Qualität",
    "Penetration": "Durchdringung",
    "Show Penetration": "Durchdringung zeigen",
    "How deep vertices lie inside the body": "Wie tief Vertices im Körper liegen",
    "Skin": "Haut",
    "Show Skin": "Haut zeigen",
    "Where covered skin shows through the cloth; on the body, by the depth of the cloth beneath": (
        "Wo bedeckte Haut durch den Stoff tritt; auf dem Körper, nach der Tiefe des Stoffs darunter"
    ),
    "Show Stretch": "Dehnung zeigen",
    "How much longer the cloth is than at rest": "Um wie viel länger der Stoff ist als in Ruhe",
    "Show Intersections": "Durchdrungenen Stoff zeigen",
    "Intersections": "Durchdrungener Stoff",
    "Where the cloth passes through itself or through other garments": (
        "Wo der Stoff durch sich selbst oder durch andere Kleidungsstücke geht"
    ),
    "Show Pushed Out": "Herausgedrücktes zeigen",
    "Pushed Out": "Herausgedrückt",
    "How far Push Out moved the rest shape": "Wie weit Herausdrücken die Ruheform verschoben hat",
    "Show": "Zeigen",
    "Show Heat": "Wärmebild zeigen",
    "Colour the garment by penetration, stretch, intersections or Push Out, the body by skin; in Solid shading": (
        "Das Kleidungsstück nach Durchdringung, Dehnung, durchdrungenem Stoff oder Herausdrücken färben, oder den "
        "Körper nach Haut, die durchtritt; in der Solid-Ansicht"
    ),
    "Red Depth": "Rote Tiefe",
    "Depth that is red": "Tiefe, die rot ist",
    "Red Stretch": "Rote Dehnung",
    "Elongation that is red": "Dehnung, die rot ist",
    "Hide Heat": "Wärmebild verbergen",
    "Remove the colours of the heat map": "Die Farben des Wärmebilds entfernen",
    "Look For": "Suchen nach",
    "Markers": "Marken",
    "How many frames are marked at most": "Wie viele Bilder höchstens markiert werden",
    "Mark Worst Frames": "Schlechteste Bilder markieren",
    "Go through the scene's frames and mark those in which most is wrong of the kind that the button shows": (
        "Die Bilder der Szene durchgehen und jene markieren, in denen am meisten von dem falsch ist, was der Knopf "
        "zeigt"
    ),
    "Clear Marks": "Marken entfernen",
    "Remove the markers of worst frames": "Die Marken der schlechtesten Bilder entfernen",
    "Linear Blend Skinning Beside": "Lineares Skinning daneben",
    "Show beside the garment how linear blend skinning alone would move it, or remove that": (
        "Daneben zeigen, wie lineares Skinning allein das Kleidungsstück bewegt, oder das wieder entfernen"
    ),
    "Export glTF": "glTF exportieren",
    "Write the character and its baked garment as a glTF binary over the scene's frames, and compare it with them": (
        "Die Figur mit ihrem gebackenen Kleidungsstück über die Bilder der Szene als glTF-Binärdatei schreiben und "
        "mit ihnen vergleichen"
    ),
    "The .glb to write": "Die zu schreibende .glb",
}
