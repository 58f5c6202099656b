"""Words of the headers that laboratories write, in English, French, German, Spanish, Italian and Japanese.

A word that joins others, as German words do, is listed whole. Japanese headers have no blanks, so Japanese
words are looked for anywhere in a header. All words are in lower case and without accents.
"""

from __future__ import annotations

MEASURED = {
    "time": """
        time temps duree zeit prufzeit versuchszeit messzeit testzeit laufzeit tiempo tempo
        """,
    "displacement": """
        displacement disp displ deplacement depl desplazamiento spostamento verschiebung
        extension elongation allongement elongacion alargamiento estensione allungamento verlangerung
        position posicion posizione weg standardweg traversenweg verfahrweg maschinenweg prufweg
        crosshead traverse traversa travel stroke hub course recorrido carrera corsa lvdt
        """,
    "force": """
        force load rf fx fy fz reaction effort charge kraft standardkraft prufkraft zugkraft
        last fuerza carga forza carico reaccion reazione
        """,
}
# A letter is a symbol only where it is the whole name: the d of "Température d'ambiance" is none.
SYMBOLS = {"t": "time", "d": "displacement", "f": "force", "力": "force"}
JAPANESE = {
    "time": ("時間",),
    "displacement": ("変位", "伸び", "ストローク", "移動量", "クロスヘッド"),
    "force": ("荷重", "試験力", "反力", "引張力"),
}

# A column with one of these words is no measured time, displacement or force.
SET_ASIDE = {
    "a set point": """
        setpoint set sp target command commanded cmd demand demanded nominal programmed desired reference ref
        soll sollwert sollweg sollkraft sollposition wegsollwert kraftsollwert vorgabe consigne commande
        cible consigna objetivo comando setpunkt obiettivo riferimento
        設定 目標 指令
        """,
    "a count": """
        step steps number no nr num count counter counts index idx id cycle cycles segment segments block
        zyklus zyklen schritt schritte nummer numero etape pas bloc ciclo ciclos cicli paso pasos passo passi
        indice
        番号 サイクル ステップ 回数
        """,
    "a rate": """
        rate speed velocity acceleration geschwindigkeit vitesse velocidad velocita accelerazione
        rapidez weggeschwindigkeit kraftrate 速度 加速度
        """,
    "an extreme or a limit": """
        max min maximum minimum maximal minimal peak limit limits threshold mean average avg median
        hochst grenze grenzwert mittel mittelwert spitze seuil limite moyenne moyen maxi mini maximo minimo
        promedio massimo media soglia error erreur fehler errore offset tare preload precharge vorkraft
        precarga precarico 最大 最小 平均 上限 下限 誤差
        """,
    "a time of day": """
        clock date day stamp timestamp datum uhrzeit heure horodatage jour fecha hora ora
        時刻 日付 日時
        """,
    "another quantity": """
        strain stress pressure temperature temp humidity stiffness modulus energy work power voltage
        dehnung spannung druck temperatur energie arbeit contrainte deformation pression rigidite
        presion temperatura deformacion esfuerzo pressione deformazione sforzo
        ひずみ 歪 応力 圧力 温度 電圧
        """,
}

WORDS = {word: quantity for quantity, words in MEASURED.items() for word in words.split()}
ASIDE = {word: reason for reason, words in SET_ASIDE.items() for word in words.split()}
